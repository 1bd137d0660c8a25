"""From a scene to what engines need: model, roles, motion, drives, forces and the initial state."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import captured_warnings, name_of
from ..clip import Clip
from ..engines.interface import Aims, Array, Role, State, Wrench
from ..engines.prescribe import prescribed_bodies
from ..errors import PantographError, SceneError
from ..kinds import BALL, FREE, HINGE
from .assemble import apply_contacts, assemble, exclude_prescribed, name_everything
from .drives import drives_of
from .floors import Floors, unite
from .goals import Goals, assign, bake
from .live import chaser, settle_roles, streamed
from .mistakes import Mistake
from .motion import Curves, constant_or_keyed, curves
from .names import Names
from .schema import Scene


@dataclass(frozen=True)
class Setup:
    """A scene resolved against its models; the plan decides how to compute it.

    ``model`` has the scene's switches applied, ``as_filed`` has none of them. ``coupled`` names joints that
    follow a keyed joint through an equality of the model, ``overruled`` options of further models that
    differ from those of the first, ``floors`` planes for which others stand. ``goals`` says which goals are
    baked and which live; ``live`` makes the targets of those that a controller follows.
    """

    scene: Scene
    model: mujoco.MjModel
    as_filed: mujoco.MjModel
    roles: NDArray[np.int8]
    clip: Clip
    curves: Curves
    coupled: tuple[str, ...]
    drives: NDArray[np.int8]
    servo: dict[int, Callable[[Array], Array]]
    wrenches: tuple[Wrench, ...]
    state0: State
    overruled: tuple[str, ...]
    floors: Floors
    goals: Goals
    live: Callable[[float], Aims] | None


def resolve(scene: Scene) -> tuple[Setup | None, list[Mistake]]:
    """A scene resolved against its models, and its mistakes; None when there are any."""
    spec, mistakes = assemble(scene)
    if spec is None:
        return None, mistakes + _law(scene)
    try:
        _compile(spec)
        name_everything(spec)
        model, overruled = _compile(spec)
        floors = unite(spec, model, scene)
        model = _compile(spec)[0] if floors else model
    except ValueError as e:
        return None, [*mistakes, Mistake(("models",), f"the models do not fit together: {e}")]
    mistakes += _law(scene)
    found, wrong = curves(scene, model)
    mistakes += wrong
    state0, wrong = _initial(scene, model)
    mistakes += wrong
    goals = Goals()
    if scene.goals and not mistakes:
        goals, mistakes = assign(scene, model, found)
        mistakes += bake(scene, model, found, state0.q, goals)
    roles, wrong = _roles(scene, model, found, goals)
    mistakes += wrong
    if goals.live and not mistakes and not (roles != Role.KEYED).any():
        moving = streamed(model, goals, found, state0.q, scene.duration, scene.rate)
        found.tracks.update({model.joint(name).id: track for name, track in moving.tracks.items()})
    mistakes += apply_contacts(spec, model, scene, floors)
    wrenches, wrong = _wrenches(scene, model)
    mistakes += wrong
    mistakes += _film_names(scene, model)
    if mistakes:
        # drives need settled roles; their own mistakes still belong into the report
        return None, mistakes + drives_of(scene, model, roles, found, goals)[2]
    try:
        clip, coupled = _clip(model, found, roles, state0.q)
    except PantographError as e:
        return None, [Mistake(("keys",), str(e))]
    keyed = np.asarray(roles[model.dof_jntid] == Role.KEYED)
    prescribed = prescribed_bodies(model, keyed)
    exclude_prescribed(spec, model, prescribed)
    as_filed, model = model, _compile(spec)[0]
    clip = Clip(model, clip.tracks, clip.q0)
    _switches(scene, model)
    _silence_equalities(model, prescribed, roles)
    drives, servo, wrong = drives_of(scene, model, roles, found, goals, clip)
    if wrong:
        return None, wrong
    state0 = _start_on_keys(scene, model, roles, clip, state0)
    live = None
    if goals.live and (roles != Role.KEYED).any():
        live = chaser(model, goals, state0.q, state0.v)
    setup = Setup(
        scene, model, as_filed, roles, clip, found, coupled, drives, servo, wrenches, state0, overruled,
        floors, goals, live,
    )  # fmt: skip
    return setup, []


def _compile(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, tuple[str, ...]]:
    """The compiled model, and the options that the first model's overrule in the others."""
    with captured_warnings(), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")  # the binding repeats MuJoCo's messages, with their details
        model = spec.compile()
    messages = [str(w.message) for w in caught]
    lines = [line for m in messages if m.startswith("Attach conflict") for line in m.split("\n")[1:]]
    names = dict.fromkeys(line.partition(":")[0] for line in lines if line)
    return model, tuple(n for n in names if n != "integrator")


def _law(scene: Scene) -> list[Mistake]:
    from ..compose import check_law

    if scene.controller is None:
        return []
    mistakes, law = [], scene.controller.law
    for words in [{}, *({word: value} for word, value in scene.controller.parameters.items())]:
        try:
            check_law(law, words)
        except SceneError as e:
            mistakes.append(Mistake(("controller", *(words or ("law",))), str(e)))
            if not words:
                break
    return mistakes


def _roles(
    scene: Scene, model: mujoco.MjModel, found: Curves, goals: Goals
) -> tuple[NDArray[np.int8], list[Mistake]]:
    """Role of each joint: named ones as the scene says, joints with keys keyed, the others passive; those
    that follow live goals are tracked, or keyed where nothing is left for physics to move."""
    roles = np.full(model.njnt, Role.PASSIVE, dtype=np.int8)
    roles[list(found.tracks)] = Role.KEYED
    joints, mistakes = Names(model, "joint"), []
    exact: dict[int, str] = {}
    for role in (Role.PASSIVE, Role.TRACKED, Role.KEYED):
        word = role.name.lower()
        for i, pattern in enumerate(getattr(scene.roles, word)):
            ids = joints.match(pattern)
            if not ids:
                mistakes.append(Mistake(("roles", word, i), joints.missing(pattern)))
            for j in ids:
                if pattern in joints.ids:
                    if exact.get(j, word) != word:
                        message = f"joint {pattern!r} is named as {exact[j]} too; give it one role"
                        mistakes.append(Mistake(("roles", word, i), message))
                    exact[j] = word
                elif j in exact:
                    continue
                roles[j] = role
    mistakes += settle_roles(scene, model, roles, goals.live_joints, set(exact))
    for keyed in np.flatnonzero(roles == Role.KEYED):
        if int(keyed) not in found.tracks and int(keyed) not in goals.live_joints:
            name = name_of(model, "joint", int(keyed))
            message = f"joint {name!r} is keyed but has no keys; add [[keys]] joint = {name!r}"
            mistakes.append(Mistake(("roles", "keyed"), message, needs=("keys",)))
    return roles, mistakes


def _initial(scene: Scene, model: mujoco.MjModel) -> tuple[State, list[Mistake]]:
    data, mistakes = mujoco.MjData(model), []
    joints = Names(model, "joint")
    if scene.initial.keyframe is not None:
        names = {model.key(k).name: k for k in range(model.nkey)}
        if scene.initial.keyframe in names:
            mujoco.mj_resetDataKeyframe(model, data, names[scene.initial.keyframe])
        else:
            listing = ", ".join(sorted(n for n in names if n)) or "none"
            message = f"no keyframe {scene.initial.keyframe!r}; the model has: {listing}"
            mistakes.append(Mistake(("initial", "keyframe"), message))
    for word, array, start in (
        ("position", data.qpos, model.jnt_qposadr),
        ("velocity", data.qvel, model.jnt_dofadr),
    ):
        for name, value in getattr(scene.initial, word).items():
            path = ("initial", word, name)
            if name not in joints.ids:
                mistakes.append(Mistake(path, joints.missing(name)))
                continue
            joint = joints.ids[name]
            row = np.atleast_1d(np.asarray(value, dtype=float))
            width = _width(model, joint, word)
            if len(row) != width:
                mistakes.append(Mistake(path, _wrong_width(model, joint, word, len(row))))
                continue
            if word == "position" and width >= 4 and not row[-4:].any():
                mistakes.append(Mistake(path, "the zero quaternion is no rotation; 1, 0, 0, 0 turns nothing"))
                continue
            if scene.angle == "degree" and model.jnt_type[joint] == HINGE:
                row = np.deg2rad(row)
            array[start[joint] : start[joint] + width] = row
    mujoco.mj_normalizeQuat(model, data.qpos)
    return State(data.qpos.copy(), data.qvel.copy(), data.act.copy()), mistakes


def _width(model: mujoco.MjModel, joint: int, word: str) -> int:
    position, velocity = {FREE: (7, 6), BALL: (4, 3)}.get(int(model.jnt_type[joint]), (1, 1))
    return position if word == "position" else velocity


def _wrong_width(model: mujoco.MjModel, joint: int, word: str, got: int) -> str:
    kind, width = int(model.jnt_type[joint]), _width(model, joint, word)
    angular = "qw, qx, qy, qz" if word == "position" else "wx, wy, wz"
    meaning = {FREE: f" (x, y, z, {angular})", BALL: f" ({angular})"}.get(kind, "")
    name = {FREE: "free", BALL: "ball", HINGE: "hinge"}.get(kind, "slide")
    return f"a {name} joint's {word} is {width} number{'s' * (width > 1)}{meaning}, got {got}"


def _start_on_keys(
    scene: Scene, model: mujoco.MjModel, roles: NDArray[np.int8], clip: Clip, state0: State
) -> State:
    """Joints with keys start on them, tracked ones unless the scene gives them a state of their own."""
    motion = clip.evaluate(0.0)
    q, v = state0.q.copy(), state0.v.copy()
    q[clip.qpos_mask], v[clip.dofs] = motion.q[clip.qpos_mask], motion.v[clip.dofs]
    joints = Names(model, "joint").ids
    for name in {*scene.initial.position, *scene.initial.velocity}:
        joint = joints[name]
        if roles[joint] == Role.KEYED:
            continue
        iq, iv = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        nq, nv = _width(model, joint, "position"), _width(model, joint, "velocity")
        if name in scene.initial.position:
            q[iq : iq + nq] = state0.q[iq : iq + nq]
        if name in scene.initial.velocity:
            v[iv : iv + nv] = state0.v[iv : iv + nv]
    return State(q, v, state0.act)


def _wrenches(scene: Scene, model: mujoco.MjModel) -> tuple[tuple[Wrench, ...], list[Mistake]]:
    bodies, out, mistakes = Names(model, "body"), [], []
    for i, item in enumerate(scene.forces):
        if item.body not in bodies.ids:
            mistakes.append(Mistake(("forces", i, "body"), bodies.missing(item.body)))
            continue
        body = bodies.ids[item.body]
        if model.body_weldid[body] == 0:
            message = f"body {item.body!r} is fixed to the world; no force can move it"
            mistakes.append(Mistake(("forces", i, "body"), message))
        force, torque = (
            constant_or_keyed(getattr(item, w), item.times, item.curve, ("forces", i, w), mistakes)
            for w in ("force", "torque")
        )
        start = -np.inf if item.start is None else item.start
        stop = np.inf if item.stop is None else item.stop
        out.append(Wrench(body, force, torque, item.frame == "body", start, stop))
    return tuple(out), mistakes


def _clip(
    model: mujoco.MjModel, found: Curves, roles: NDArray[np.int8], q0: Array
) -> tuple[Clip, tuple[str, ...]]:
    """The clip of all joints with keys, and the passive joints that an equality ties to keyed ones: these
    become keyed."""
    clip = Clip(model, {name_of(model, "joint", j): t for j, t in found.tracks.items()}, q0)
    tied = clip.with_coupled()
    coupled = []
    for name in tied.tracks.keys() - clip.tracks.keys():
        joint = model.joint(name).id
        others = [
            int(b if a == joint else a)
            for a, b, kind in zip(model.eq_obj1id, model.eq_obj2id, model.eq_type, strict=True)
            if kind == mujoco.mjtEq.mjEQ_JOINT and joint in (a, b)
        ]
        if roles[joint] == Role.PASSIVE and any(roles[o] == Role.KEYED for o in others if o >= 0):
            roles[joint] = Role.KEYED
            coupled.append(name)
    return tied, tuple(sorted(coupled))


def _switches(scene: Scene, model: mujoco.MjModel) -> None:
    physics, disable = scene.physics, mujoco.mjtDisableBit
    if physics.contacts == "none":
        model.opt.disableflags |= int(disable.mjDSBL_CONTACT)
    if not physics.limits:
        model.opt.disableflags |= int(disable.mjDSBL_LIMIT)
    if not physics.friction:
        model.opt.disableflags |= int(disable.mjDSBL_FRICTIONLOSS)
    if physics.gravity is False:
        model.opt.disableflags |= int(disable.mjDSBL_GRAVITY)
    elif physics.gravity is not True:
        model.opt.gravity[:] = physics.gravity


def _silence_equalities(
    model: mujoco.MjModel, prescribed: NDArray[np.bool_], roles: NDArray[np.int8]
) -> None:
    """Equalities between things that all move as keyed cannot act; the keys already decide."""
    for e in range(model.neq):
        ends = [int(model.eq_obj1id[e]), int(model.eq_obj2id[e])]
        if model.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT:
            if all(j < 0 or roles[j] == Role.KEYED for j in ends):
                model.eq_active0[e] = 0
        elif model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_BODY and all(prescribed[b] for b in ends):
            model.eq_active0[e] = 0


def _film_names(scene: Scene, model: mujoco.MjModel) -> list[Mistake]:
    mistakes, bodies, cameras = [], Names(model, "body"), Names(model, "camera")
    for i, camera in enumerate(scene.cameras):
        if camera.body is not None and camera.body not in bodies.ids:
            mistakes.append(Mistake(("cameras", i, "body"), bodies.missing(camera.body)))
        if camera.kind == "model" and camera.name not in cameras.ids:
            mistakes.append(Mistake(("cameras", i, "name"), cameras.missing(camera.name)))
    known = {c.name for c in scene.cameras} | set(cameras.ids)
    if scene.film.camera is not None and scene.film.camera not in known:
        listing = ", ".join(sorted(known)) or "none"
        message = f"no camera {scene.film.camera!r}; there is: {listing}"
        mistakes.append(Mistake(("film", "camera"), message, needs=("cameras",)))
    return mistakes
