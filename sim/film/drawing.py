"""What is drawn of a model: geoms that share a surface and a material, gathered into batches."""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from .shapes import Shape, geom_shape

Floats = NDArray[np.floating]

VISUAL_GROUPS = 3  # geom groups 0, 1, 2 are for the eye; 3 and above are collision shapes by custom
_UNSET_RGBA = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's mark for "the material's colour"


@dataclass(frozen=True)
class Material:
    """Look of a batch: display RGBA, Blinn-Phong constants, and the texture with its mapping.

    A 2d texture is read at `uv * uv_scale + uv_offset`, a cube texture in the direction of the point in the
    geom's frame times `cube_scale`.
    """

    rgba: tuple[float, float, float, float]
    specular: float
    exponent: float
    emission: float
    texture: int
    uv_scale: tuple[float, float]
    uv_offset: tuple[float, float]
    cube_scale: tuple[float, float, float]


@dataclass(frozen=True)
class Batch:
    """Geoms drawn by one call."""

    geoms: NDArray[np.integer]
    shape: Shape
    material: Material
    ground: bool

    @property
    def opaque(self) -> bool:
        """Whether nothing shines through."""
        return self.material.rgba[3] >= 0.999


def drawn_geoms(model: mujoco.MjModel) -> list[int]:
    """Geoms that are seen: those of the visual groups or, in a model without any, all; none invisible."""
    seen = [g for g in range(model.ngeom) if _rgba(model, g)[3] > 0]
    visual = [g for g in seen if model.geom_group[g] < VISUAL_GROUPS]
    return visual or seen


def batches(model: mujoco.MjModel, *, plane_radius: float) -> tuple[list[Batch], tuple[str, ...]]:
    """The batches of a model, and a sentence for everything in it that is not drawn as the file asks.

    `plane_radius`: half side in metres at which infinite planes end.
    """
    notes: dict[str, None] = {}
    groups: dict[tuple[object, ...], list[int]] = {}
    for geom in drawn_geoms(model):
        material = _material(model, geom)
        alone = geom if material.rgba[3] < 0.999 else -1  # transparent geoms are sorted one by one
        size = tuple(np.round(model.geom_size[geom], 9))
        key = (int(model.geom_type[geom]), int(model.geom_dataid[geom]), size, material, alone)
        groups.setdefault(key, []).append(geom)
    result = []
    for members in groups.values():
        shape = geom_shape(model, members[0], plane_radius=plane_radius)
        if shape is None:
            for geom in members:
                kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
                notes[f"geom {model.geom(geom).name or geom}: {kind} geoms without a mesh are not drawn"] = (
                    None
                )
            continue
        ground = int(model.geom_type[members[0]]) == mujoco.mjtGeom.mjGEOM_PLANE
        result.append(Batch(np.array(members), shape, _material(model, members[0]), ground))
    notes.update(dict.fromkeys(_left_out(model)))
    return result, tuple(notes)


def _left_out(model: mujoco.MjModel) -> Iterator[str]:
    for i in range(model.nmat):
        if model.mat_reflectance[i] > 0:
            yield f"material {model.mat(i).name or i}: reflectance is not drawn"
    for count, what in ((model.nskin, "skins"), (model.nflex, "flexes")):
        if count:
            yield f"{what} are not drawn"
    if (model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any():
        yield "the skybox texture gives way to the film's background"


def _rgba(model: mujoco.MjModel, geom: int) -> tuple[float, float, float, float]:
    own = tuple(float(x) for x in model.geom_rgba[geom])
    material = int(model.geom_matid[geom])
    if material >= 0 and np.allclose(own, _UNSET_RGBA):
        own = tuple(float(x) for x in model.mat_rgba[material])
    return own[0], own[1], own[2], own[3]


def _material(model: mujoco.MjModel, geom: int) -> Material:
    index = int(model.geom_matid[geom])
    rgba = _rgba(model, geom)
    if index < 0:
        return Material(rgba, 0.5, 64.0, 0.0, -1, (1.0, 1.0), (0.0, 0.0), (1.0, 1.0, 1.0))
    roles = mujoco.mjtTextureRole
    texture = max(
        int(model.mat_texid[index, roles.mjTEXROLE_RGB]), int(model.mat_texid[index, roles.mjTEXROLE_RGBA])
    )
    scale, offset, cube = _mapping(model, geom, index)
    return Material(
        rgba,
        float(model.mat_specular[index]),
        max(1.0, 128.0 * float(model.mat_shininess[index])),
        float(model.mat_emission[index]),
        texture,
        scale,
        offset,
        cube,
    )


def _mapping(
    model: mujoco.MjModel, geom: int, material: int
) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float, float]]:
    """MuJoCo's texture mapping (its render_gl3.c): 2d over x and y, cube along the point's direction.

    `texuniform` counts repeats per two metres for 2d textures, and maps cubes on the unit shape.
    """
    repeat_x, repeat_y = (float(x) for x in model.mat_texrepeat[material])
    uniform = bool(model.mat_texuniform[material])
    kind = int(model.geom_type[geom])
    size = np.array(model.geom_size[geom])
    types = mujoco.mjtGeom
    if kind in (types.mjGEOM_MESH, types.mjGEOM_SDF):
        if model.mesh_texcoordadr[int(model.geom_dataid[geom])] >= 0:
            return (repeat_x, repeat_y), (0.0, 0.0), (1.0, 1.0, 1.0)
        size = np.ones(3)
    elif kind == types.mjGEOM_HFIELD:
        size = np.array(model.hfield_size[int(model.geom_dataid[geom])][:3])
    elif kind in (types.mjGEOM_SPHERE, types.mjGEOM_CAPSULE, types.mjGEOM_CYLINDER):
        size = np.array([size[0], size[0], size[0] if kind == types.mjGEOM_SPHERE else size[1]])
    spans = np.where(size > 0, size, 1.0)
    per_x, per_y = (1.0, 1.0) if uniform else (1.0 / spans[0], 1.0 / spans[1])
    cube = tuple(float(x) for x in 1.0 / spans) if uniform else (1.0, 1.0, 1.0)
    return (0.5 * repeat_x * per_x, -0.5 * repeat_y * per_y), (-0.5, -0.5), (cube[0], cube[1], cube[2])
