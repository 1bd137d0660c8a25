"""Floors that several models or props bring at the same place: one plane stands for all of them."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
from numpy.typing import NDArray

from .schema import Scene

Floors = dict[str, str]
"""Name of a plane -> name of the one that stands for it."""

_APART = 1e-6  # m, and rad: planes closer than this are the same
_PLANE = mujoco.mjtGeom.mjGEOM_PLANE


def name_planes(spec: mujoco.MjSpec) -> None:
    """Give the unnamed planes of a model names, which tell later whose they are."""
    taken = {geom.name for geom in spec.geoms}
    free = (name for i in itertools.count() if (name := f"plane{i}") not in taken)
    for geom in spec.geoms:
        if geom.type == _PLANE and not geom.name:
            geom.name = next(free)


def unite(spec: mujoco.MjSpec, model: mujoco.MjModel, scene: Scene) -> Floors:
    """Let fixed planes of different models and props that coincide be one; ``model`` is the spec compiled.

    MuJoCo's planes have no end for contacts, so two at one place would double them, and flicker in a film.
    One that things can touch stays rather than one that is only seen, then a prop's, then the first model's.
    It grows to be seen where the others were; these stay in the model, out of sight and touch.
    """
    planes = _fixed_planes(model, scene)
    if len({owner for _, owner in planes}) < 2:
        return {}
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geoms = list(spec.geoms)
    found: Floors = {}
    kept: list[tuple[int, str]] = []
    for geom, owner in planes:
        same = [k for k, other in kept if other != owner and _coincide(data, k, geom)]
        if not same:
            kept.append((geom, owner))
            continue
        found[model.geom(geom).name] = model.geom(same[0]).name
        _cover(spec, geoms[same[0]], geoms[geom], _reach(model, data, same[0], geom))
    for pair in spec.pairs:
        pair.geomname1 = found.get(pair.geomname1, pair.geomname1)
        pair.geomname2 = found.get(pair.geomname2, pair.geomname2)
    return found


def _fixed_planes(model: mujoco.MjModel, scene: Scene) -> list[tuple[int, str]]:
    """Planes that stand still, with whose they are; in the order in which they are kept."""
    props = [prop.name for prop in scene.props]
    models = [str(item.name) for item in scene.models]
    order = [*props, *models, ""]
    planes = []
    for geom in np.flatnonzero(model.geom_type == int(_PLANE)):
        body = int(model.geom_bodyid[geom])
        prefix = model.geom(geom).name.partition("/")[0]
        owner = model.body(body).name if model.body(body).name in props else prefix
        if model.body_weldid[body] == 0 and model.body_mocapid[model.body_rootid[body]] < 0:
            planes.append((int(geom), owner if owner in order else ""))
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return sorted(planes, key=lambda plane: (not touching[plane[0]], order.index(plane[1])))


def _coincide(data: mujoco.MjData, one: int, other: int) -> bool:
    up, up2 = (data.geom_xmat[g].reshape(3, 3)[:, 2] for g in (one, other))
    height = up @ (data.geom_xpos[other] - data.geom_xpos[one])
    return bool(np.linalg.norm(up - up2) < _APART and abs(height) < _APART)


def _reach(model: mujoco.MjModel, data: mujoco.MjData, kept: int, other: int) -> NDArray[np.float64]:
    """Half sizes (2,) [m] of the plane ``kept`` with which it covers the other too; 0 has no end."""
    own, size = model.geom_size[kept, :2], model.geom_size[other, :2]
    if (own == 0).any() or (size == 0).any():
        return np.zeros(2)
    corners = np.array(list(itertools.product((-1, 1), (-1, 1), (0,)))) * np.append(size, 0.0)
    X_W = data.geom_xpos[other] + corners @ data.geom_xmat[other].reshape(3, 3).T
    seen = (X_W - data.geom_xpos[kept]) @ data.geom_xmat[kept].reshape(3, 3)
    return np.asarray(np.maximum(own, np.abs(seen[:, :2]).max(axis=0)))


def _cover(
    spec: mujoco.MjSpec, kept: mujoco.MjsGeom, other: mujoco.MjsGeom, reach: NDArray[np.float64]
) -> None:
    """Let a plane stand for another, out to ``reach``; its pattern keeps its scale."""
    if kept.material and not np.array_equal(reach, kept.size[:2]):
        kept.material = _scaled(spec, kept)
    kept.size[:2] = reach
    kept.contype |= other.contype
    kept.conaffinity |= other.conaffinity
    other.contype = other.conaffinity = 0
    other.rgba = [0, 0, 0, 0]


def _scaled(spec: mujoco.MjSpec, plane: mujoco.MjsGeom) -> str:
    """A copy of a plane's material whose images have a size in metres: so many over two metres."""
    original, name = spec.material(plane.material), f"{plane.name}:floor"
    if original.texuniform or spec.material(name) is not None:
        return str(plane.material)
    copy = spec.add_material(name=name)
    for word in ("emission", "metallic", "reflectance", "roughness", "shininess", "specular", "rgba"):
        setattr(copy, word, getattr(original, word))
    for role, texture in enumerate(original.textures):
        copy.textures[role] = texture
    copy.texrepeat = [float(r / (s or 1.0)) for r, s in zip(original.texrepeat, plane.size[:2], strict=True)]
    copy.texuniform = True
    return name
