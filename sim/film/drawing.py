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
class Checker:
    """Squares of two display colours, two by two to the image, and lines of a third along its edges.

    `edge`: half the width of the lines, as a fraction of the image.
    """

    colors: tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
    edge: float = 0.0


@dataclass(frozen=True)
class Material:
    """Look of a batch: display RGBA, Blinn-Phong constants, and the texture with its mapping.

    A 2d texture is read at `uv * uv_scale`, a cube texture in the direction of the point in the
    geom's frame times `cube_scale`.
    """

    rgba: tuple[float, float, float, float]
    specular: float
    exponent: float
    emission: float
    texture: int
    uv_scale: tuple[float, float]
    cube_scale: tuple[float, float, float]
    checker: Checker | None = None


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
    # a plain sky is as good as the film's own; a picture of one is somebody's intention
    pictured = (model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX) & (model.tex_pathadr >= 0)
    if pictured.any():
        yield "the picture of the skybox gives way to the film's background"


def _rgba(model: mujoco.MjModel, geom: int) -> tuple[float, float, float, float]:
    own = tuple(float(x) for x in model.geom_rgba[geom])
    material = int(model.geom_matid[geom])
    if material >= 0 and np.allclose(own, _UNSET_RGBA):
        own = tuple(float(x) for x in model.mat_rgba[material])
    return own[0], own[1], own[2], own[3]


def _material(model: mujoco.MjModel, geom: int) -> Material:
    index = int(model.geom_matid[geom])
    rgba = _rgba(model, geom)
    specular, exponent, emission, texture = 0.5, 64.0, 0.0, -1
    scale, cube = (1.0, 1.0), (1.0, 1.0, 1.0)
    if index >= 0:
        specular, emission = float(model.mat_specular[index]), float(model.mat_emission[index])
        exponent = max(1.0, 128.0 * float(model.mat_shininess[index]))
        roles = mujoco.mjtTextureRole
        texture = max(
            int(model.mat_texid[index, int(r)]) for r in (roles.mjTEXROLE_RGB, roles.mjTEXROLE_RGBA)
        )
        scale, cube = _mapping(model, geom, index)
    checker = _checker_of(model, texture) if texture >= 0 else None
    if texture < 0 and int(model.geom_type[geom]) == mujoco.mjtGeom.mjGEOM_PLANE:
        # A bare floor gets faint squares: without them nobody sees what moves over it, or how far.
        checker = Checker(((1.0, 1.0, 1.0), (0.9, 0.9, 0.9), (1.0, 1.0, 1.0)))
        x, y = (float(s) or 1.0 for s in model.geom_size[geom][:2])
        scale = (x / _square(model), y / _square(model))
    return Material(rgba, specular, exponent, emission, texture, scale, cube, checker)


def _square(model: mujoco.MjModel) -> float:
    """Side in metres of a bare floor's squares: 1, 2 or 5 times a power of ten, near a third of the model."""
    third = max(float(model.stat.extent), 1e-6) / 3
    power = 10.0 ** np.floor(np.log10(third))
    return float(power * max(step for step in (1, 2, 5) if step * power <= third * (1 + 1e-9)))


def _checker_of(model: mujoco.MjModel, texture: int) -> Checker | None:
    """The checker that an image is, if it is one: drawn as a formula it stays sharp and free of moire."""
    if model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D or model.tex_nchannel[texture] < 3:
        return None
    pixels = texture_pixels(model, texture)[:, :, :3]
    h, w = pixels.shape[:2]
    squares = np.where(
        ((np.arange(h) * 2 // h)[:, None] == np.arange(w) * 2 // w)[..., None],
        pixels[h // 4, w // 4],
        pixels[h // 4, w - 1 - w // 4],
    )
    for edge in range(min(4, h // 4, w // 4)):
        inner = np.s_[edge : h - edge, edge : w - edge]
        framed = np.tile(pixels[0, 0], (h, w, 1)) if edge else squares.copy()
        framed[inner] = squares[inner]
        if np.abs(framed.astype(int) - pixels).max() <= 1:
            first, second, line = (
                tuple(float(x) / 255 for x in color)
                for color in (squares[h // 4, w // 4], squares[h // 4, w - 1 - w // 4], pixels[0, 0])
            )
            return Checker((first, second, line), edge / w)
    return None


def texture_pixels(model: mujoco.MjModel, texture: int) -> NDArray[np.uint8]:
    """A texture of the model as (height, width, channels); the six sides of a cube are stacked downwards."""
    width, height = int(model.tex_width[texture]), int(model.tex_height[texture])
    channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    data = model.tex_data[start : start + width * height * channels]
    return np.asarray(data, dtype=np.uint8).reshape(height, width, channels)


def _mapping(
    model: mujoco.MjModel, geom: int, material: int
) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Scales of the 2d coordinates and of the cube's direction, found from pictures that MuJoCo draws.

    2d: `texrepeat` images over each face; with `texuniform`, that many over two metres. Cube: the direction
    of the point on the unit shape; with `texuniform`, of the point itself.
    """
    repeat_x, repeat_y = (float(x) for x in model.mat_texrepeat[material])
    uniform = bool(model.mat_texuniform[material])
    types = mujoco.mjtGeom
    kind = int(model.geom_type[geom])
    x, y, z = (float(s) for s in model.geom_size[geom])
    if kind in (types.mjGEOM_SPHERE, types.mjGEOM_CAPSULE, types.mjGEOM_CYLINDER):
        x, y, z = x, x, x if kind == types.mjGEOM_SPHERE else y
    if kind == types.mjGEOM_HFIELD:
        x, y = (float(s) for s in model.hfield_size[int(model.geom_dataid[geom])][:2])
    if kind in (types.mjGEOM_MESH, types.mjGEOM_SDF):
        return (repeat_x, repeat_y), (x, y, z) if uniform else (1.0, 1.0, 1.0)
    x, y, z = x or 1.0, y or 1.0, z or 1.0
    scale = (repeat_x * x, repeat_y * y) if uniform else (repeat_x, repeat_y)
    return scale, (1.0, 1.0, 1.0) if uniform else (1 / x, 1 / y, 1 / z)
