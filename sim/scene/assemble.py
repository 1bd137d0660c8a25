"""From the models and props of a scene to one compiled mujoco.MjModel."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import captured_warnings, chain, load_spec
from ..errors import ModelError, unknown
from .floors import Floors, name_planes
from .mistakes import Mistake
from .schema import ModelItem, Placement, PropItem, Scene

_SHAPES = {
    "plane": mujoco.mjtGeom.mjGEOM_PLANE,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}


def assemble(scene: Scene) -> tuple[mujoco.MjSpec | None, list[Mistake]]:
    """One spec of all models and props, with their placement; the mistakes that kept a part out."""
    mistakes: list[Mistake] = []
    specs: list[tuple[ModelItem, mujoco.MjSpec]] = []
    for i, item in enumerate(scene.models):
        try:
            specs.append((item, _load(item, scene)))
        except ModelError as e:
            mistakes.append(Mistake(("models", i, "chain" if item.chain else "file"), str(e)))
    if mistakes:
        return None, mistakes
    spec = _host(specs, scene)
    mistakes += _add_props(spec, scene)
    return (None if mistakes else spec), mistakes


def _load(item: ModelItem, scene: Scene) -> mujoco.MjSpec:
    if item.chain is not None:
        options = item.chain.model_dump()
        return chain(options.pop("links"), **options)
    return load_spec(str(item.file), base=scene.base)


def _host(specs: list[tuple[ModelItem, mujoco.MjSpec]], scene: Scene) -> mujoco.MjSpec:
    """A lone unnamed model is the world itself; named ones are attached to a fresh world.

    Options (time step, gravity, solver) come from the first model.
    """
    if len(specs) == 1 and specs[0][0].name is None:
        item, host = specs[0]
        if not _is_origin(item):
            _move(host, item, scene)
        return host
    host = mujoco.MjSpec()
    host.modelname = scene.title or "scene"
    for i, (item, child) in enumerate(specs):
        if i == 0:
            _copy_options(child, host)
        frame = host.worldbody.add_frame(pos=item.position, quat=_quat(item, scene))
        name_planes(child)
        with captured_warnings():  # of options that differ; compiling repeats them
            host.attach(child, prefix=f"{item.name}/", frame=frame)
    return host


def _move(spec: mujoco.MjSpec, item: ModelItem, scene: Scene) -> None:
    """Put everything that stands in the world of ``spec`` into one placed frame."""
    world = spec.worldbody
    things = [x for kind in ("bodies", "geoms", "sites", "cameras", "lights") for x in getattr(world, kind)]
    outer = [f for f in world.frames if f.frame is None]
    frame = world.add_frame(pos=item.position, quat=_quat(item, scene))
    for thing in [*outer, *(x for x in things if x.frame is None)]:
        thing.set_frame(frame)


def _copy_options(child: mujoco.MjSpec, host: mujoco.MjSpec) -> None:
    for section in ("option", "visual", "stat"):
        source, target = getattr(child, section), getattr(host, section)
        names = [n for n in dir(source) if not n.startswith("_") and not callable(getattr(source, n))]
        for name in names:
            value = getattr(source, name)
            if isinstance(value, np.ndarray):
                getattr(target, name)[:] = value
            elif isinstance(value, int | float):
                setattr(target, name, value)


_PROP = "prop:"


def _add_props(spec: mujoco.MjSpec, scene: Scene) -> list[Mistake]:
    """Props come from a spec of their own, so that no model's defaults reach them."""
    loose, mistakes = mujoco.MjSpec(), []
    taken = {b.name for b in spec.bodies} | {j.name for j in spec.joints} | {g.name for g in spec.geoms}
    for i, prop in enumerate(scene.props):
        if prop.name in taken:
            mistakes.append(
                Mistake(("props", i, "name"), f"the models have a {prop.name!r} already; choose another name")
            )
        elif prop.file is not None and not (scene.base / prop.file).is_file():
            mistakes.append(Mistake(("props", i, "file"), f"no mesh file {scene.base / prop.file}"))
        else:
            _add_prop(loose, prop, scene)
    if mistakes or not scene.props:
        return mistakes
    spec.attach(loose, prefix=_PROP, frame=spec.worldbody.add_frame())
    for thing in [*spec.bodies, *spec.joints, *spec.geoms]:
        thing.name = thing.name.removeprefix(_PROP)
    return []


def _add_prop(spec: mujoco.MjSpec, prop: PropItem, scene: Scene) -> None:
    body = spec.worldbody.add_body(name=prop.name, pos=prop.position, quat=_quat(prop, scene))
    if not prop.fixed:
        body.add_freejoint(name=prop.name)
    size = np.zeros(3)
    size[: len(prop.size)] = prop.size
    if prop.shape == "plane":
        size[2] = 0.05
    rgba = (*prop.color, 1.0) if len(prop.color) == 3 else prop.color
    geom = body.add_geom(name=prop.name, type=_SHAPES[prop.shape], size=size, rgba=rgba)
    if prop.mass is not None:
        geom.mass = prop.mass
    if prop.friction is not None:
        geom.friction[0] = prop.friction
    if prop.file is not None:
        spec.add_mesh(name=prop.name, file=str((scene.base / prop.file).resolve()))
        geom.meshname = prop.name
    elif prop.shape == "plane":
        _checker(spec, geom, rgba, prop)


def _checker(spec: mujoco.MjSpec, geom: mujoco.MjsGeom, rgba: tuple[float, ...], prop: PropItem) -> None:
    dark = [0.86 * c for c in rgba[:3]]
    spec.add_texture(
        name=prop.name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=rgba[:3],
        rgb2=dark,
        width=256,
        height=256,
    )
    material = spec.add_material(name=prop.name, texrepeat=[2 * prop.size[0], 2 * prop.size[1]])
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = prop.name
    geom.material = prop.name
    geom.rgba = [1, 1, 1, rgba[3]]


def _quat(item: Placement, scene: Scene) -> list[float]:
    if item.euler is not None:
        angles = np.deg2rad(item.euler) if scene.angle == "degree" else np.asarray(item.euler)
        quat = np.zeros(4)
        # fixed axes: X, Y, Z in capitals are extrinsic for MuJoCo
        mujoco.mju_euler2Quat(quat, np.asarray(angles, dtype=float), "XYZ")
        return [float(c) for c in quat]
    return list(item.rotation or (1.0, 0.0, 0.0, 0.0))


def _is_origin(item: Placement) -> bool:
    return item.position == (0.0, 0.0, 0.0) and item.euler is None and item.rotation in (None, (1, 0, 0, 0))


def apply_contacts(spec: mujoco.MjSpec, model: mujoco.MjModel, scene: Scene, floors: Floors) -> list[Mistake]:
    """Write the scene's choice of contacts into the spec; ``model`` is the same spec compiled, ``floors`` are
    planes for which others stand."""
    choice = scene.physics.contacts
    if choice == "none":
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    if isinstance(choice, str):
        return []
    mistakes = []
    pairs: set[tuple[int, int]] = set()
    for i, names in enumerate(choice):
        sides = []
        for j, name in enumerate(names):
            geoms = _geoms_of(model, name, floors)
            if not geoms:
                mistakes.append(Mistake(("physics", "contacts", i, j), _untouchable(model, name, floors)))
            sides.append(geoms)
        pairs |= {(min(a, b), max(a, b)) for a in sides[0] for b in sides[1] if a != b}
    shapes = list(spec.geoms)
    for k, (a, b) in enumerate(sorted(pairs)):
        spec.add_pair(name=f"scene_pair{k}", geomname1=shapes[a].name, geomname2=shapes[b].name)
    for geom in shapes:
        geom.contype = 0
        geom.conaffinity = 0
    return mistakes


def name_everything(spec: mujoco.MjSpec) -> None:
    """Give unnamed joints, bodies and geoms of a compiled spec the names that messages show."""
    for kind in ("joint", "body", "geom"):
        things = {"joint": spec.joints, "body": spec.bodies, "geom": spec.geoms}[kind]
        taken = {thing.name for thing in things}
        for thing in things:
            if not thing.name and f"{kind}{thing.id}" not in taken:
                thing.name = f"{kind}{thing.id}"


def _geoms_of(model: mujoco.MjModel, name: str, floors: Floors) -> list[int]:
    """Geoms that a name of a body or geom means; visual geoms never touch."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body >= 0:
        start = model.body_geomadr[body]
        found = range(start, start + model.body_geomnum[body])
    else:
        geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
        found = range(geom, geom + 1) if geom >= 0 else range(0)
    named = [model.geom(g).name for g in found]
    standing = dict.fromkeys(model.geom(floors.get(n, n)).id for n in named)
    return [g for g in standing if model.geom_contype[g] or model.geom_conaffinity[g]]


def _untouchable(model: mujoco.MjModel, name: str, floors: Floors) -> str:
    """Why nothing can touch a body or geom of this name."""
    names = {model.body(b).name for b in range(model.nbody)} | {
        model.geom(g).name for g in range(model.ngeom)
    }
    touching = [n for n in names if _geoms_of(model, n, floors)]
    if name not in names:
        return unknown("body or geom", name, touching, where="of those that can touch, the scene")
    return f"{name!r} has no geom that can touch; these have: {', '.join(sorted(touching)) or 'none'}"


def exclude_prescribed(spec: mujoco.MjSpec, model: mujoco.MjModel, prescribed: NDArray[np.bool_]) -> None:
    """No contacts between bodies that both move as keyed (mask (nbody,)): neither could yield."""
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    bodies = [b for b in range(model.nbody) if prescribed[b] and touching[model.geom_bodyid == b].any()]
    names = [model.body(b).name for b in bodies]
    for i, b1 in enumerate(bodies):
        for j in range(i + 1, len(bodies)):
            static = model.body_weldid[b1] == 0 and model.body_weldid[bodies[j]] == 0
            if not static:
                spec.add_exclude(bodyname1=names[i], bodyname2=names[j])
    for pair in list(spec.pairs):
        ends = [
            mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, n) for n in (pair.geomname1, pair.geomname2)
        ]
        if all(g >= 0 and prescribed[model.geom_bodyid[g]] for g in ends):
            spec.delete(pair)
