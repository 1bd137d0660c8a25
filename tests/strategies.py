"""Random models and states for laws that must hold for any of them."""

import mujoco
import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

Array = NDArray[np.float64]
_JOINT = {
    "free": mujoco.mjtJoint.mjJNT_FREE,
    "ball": mujoco.mjtJoint.mjJNT_BALL,
    "slide": mujoco.mjtJoint.mjJNT_SLIDE,
    "hinge": mujoco.mjtJoint.mjJNT_HINGE,
}

seeds = st.integers(0, 2**32 - 1)


@st.composite
def trees(draw, *, max_bodies: int = 6, joints: tuple[str, ...] = ("free", "ball", "slide", "hinge")):
    """A random model: bodies b0, b1, ... with joints j0, ..., geoms g0, ... and sites s0, ...

    Structure (parents, joints) is drawn, numbers come from a drawn seed. Every joint type, up to three joints
    a body, joints away from the body's origin, reference angles, welded bodies, skew inertias; no contacts.
    """
    rng = np.random.default_rng(draw(seeds))
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    single = [j for j in joints if j in ("slide", "hinge")]
    bodies = [spec.worldbody]
    count = 0
    for i in range(draw(st.integers(1, max_bodies))):
        parent = draw(st.integers(0, i))
        sets = st.lists(st.sampled_from(single), max_size=3) if single else st.just([])
        if "ball" in joints:
            sets |= st.sampled_from([["ball"], ["slide", "ball"]]) if "slide" in joints else st.just(["ball"])
        if parent == 0 and "free" in joints:
            sets |= st.just(["free"])
        body = bodies[parent].add_body(name=f"b{i}", pos=rng.normal(size=3), quat=_quat(rng))
        body.add_geom(
            name=f"g{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=rng.uniform(0.1, 0.6, 3),
            pos=rng.normal(size=3),
            quat=_quat(rng),
            contype=0,
            conaffinity=0,
        )
        body.add_site(name=f"s{i}", pos=rng.normal(size=3), quat=_quat(rng))
        for kind in draw(sets):
            placed = {} if kind == "free" else {"pos": rng.normal(size=3)}
            if kind in ("slide", "hinge"):
                placed |= {"axis": rng.normal(size=3), "ref": rng.normal()}
            body.add_joint(name=f"j{count}", type=_JOINT[kind], **placed)
            count += 1
        bodies.append(body)
    return spec.compile()


def random_states(model: mujoco.MjModel, seed: int, n: int = 4) -> tuple[Array, Array, Array]:
    """Configurations (n, nq) on the manifold, velocities and accelerations (n, nv), from a seed."""
    rng = np.random.default_rng(seed)
    q = np.tile(model.qpos0, (n, 1))
    for row in q:
        mujoco.mj_integratePos(model, row, 3 * rng.normal(size=model.nv), 1.0)
    return q, rng.normal(size=(n, model.nv)), rng.normal(size=(n, model.nv))


def _quat(rng: np.random.Generator) -> Array:
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)
