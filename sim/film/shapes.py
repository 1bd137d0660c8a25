"""Triangles, normals and texture coordinates of every MuJoCo geom type, in the geom's frame."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]

_SEGMENTS = 48  # round the axis of a curved shape
_RINGS = 24  # from pole to pole
_CREASE = np.deg2rad(35.0)  # faces that meet at a sharper angle are shaded apart


@dataclass(frozen=True)
class Shape:
    """A triangle surface: positions (n, 3), normals (n, 3), uv (n, 2) or None, indices (m, 3)."""

    positions: Floats
    normals: Floats
    indices: NDArray[np.integer]
    uv: Floats | None = None


def geom_shape(model: mujoco.MjModel, geom: int, *, plane_radius: float) -> Shape | None:
    """The surface of a geom in its own frame, or None for a type that has none.

    A plane's infinite directions (size 0) end at `plane_radius` metres. Primitives carry the texture
    coordinates that MuJoCo derives from x and y (`unit_uv`); meshes carry their own where they have them.
    """
    kind = mujoco.mjtGeom(model.geom_type[geom])
    size = model.geom_size[geom]
    data = int(model.geom_dataid[geom])
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_PLANE:
        half = np.where(size[:2] > 0, size[:2], plane_radius)
        return _plane(half)
    if kind == types.mjGEOM_SPHERE:
        return _ellipsoid(np.full(3, size[0]))
    if kind == types.mjGEOM_ELLIPSOID:
        return _ellipsoid(size)
    if kind == types.mjGEOM_CAPSULE:
        return _revolved(*_capsule_profile(size[0], size[1]))
    if kind == types.mjGEOM_CYLINDER:
        return _revolved(*_cylinder_profile(size[0], size[1]))
    if kind == types.mjGEOM_BOX:
        return _box(size)
    if kind == types.mjGEOM_HFIELD and data >= 0:
        return _height_field(model, data)
    if kind in (types.mjGEOM_MESH, types.mjGEOM_SDF) and data >= 0:
        return _mesh(model, data)
    return None


def _plane(half: Floats) -> Shape:
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*half, 0.0]
    return Shape(corners, np.tile([0.0, 0, 1], (4, 1)), np.array([[0, 1, 2], [0, 2, 3]]), corners[:, :2])


def _grid_indices(rows: int, columns: int) -> NDArray[np.integer]:
    """Two triangles, counterclockwise from outside, for each cell of a grid of rows x columns vertices."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (row * columns + column).ravel()
    b, c, d = a + 1, a + columns + 1, a + columns
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _revolved(radius: Floats, height: Floats, normal_r: Floats, normal_z: Floats) -> Shape:
    """A profile (from bottom to top) turned about z."""
    angle = np.linspace(0, 2 * np.pi, _SEGMENTS + 1)
    cosine, sine = np.cos(angle), np.sin(angle)

    def turned(r: Floats, z: Floats) -> Floats:
        around = np.broadcast_to(z[:, None], (len(r), len(angle)))
        return np.stack([np.outer(r, cosine), np.outer(r, sine), around], -1).reshape(-1, 3)

    positions = turned(radius, height)
    return Shape(
        positions,
        turned(normal_r, normal_z),
        _grid_indices(len(radius), len(angle)),
        positions[:, :2],
    )


def _ellipsoid(size: Floats) -> Shape:
    latitude = np.linspace(-np.pi / 2, np.pi / 2, _RINGS + 1)
    r, z = np.cos(latitude), np.sin(latitude)
    unit = _revolved(r, z, r, z)
    normals = unit.positions / size
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    positions = unit.positions * size
    return Shape(positions, normals, unit.indices, positions[:, :2])


def _capsule_profile(radius: float, half: float) -> tuple[Floats, ...]:
    latitude = np.linspace(0, np.pi / 2, _RINGS // 2 + 1)
    r = np.concatenate([np.cos(latitude[::-1]), np.cos(latitude)])
    z = np.concatenate([-np.sin(latitude[::-1]), np.sin(latitude)])
    shift = np.repeat([-half, half], len(latitude))
    return radius * r, radius * z + shift, r, z


def _cylinder_profile(radius: float, half: float) -> tuple[Floats, ...]:
    r = np.array([0.0, radius, radius, radius, radius, 0.0])
    z = half * np.array([-1.0, -1, -1, 1, 1, 1])
    return r, z, np.array([0.0, 0, 1, 1, 0, 0]), np.array([-1.0, -1, 0, 0, 1, 1])


def _box(size: Floats) -> Shape:
    positions, normals = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            n, u = np.zeros(3), np.zeros(3)
            n[axis], u[(axis + 1) % 3] = sign, 1.0
            v = np.cross(n, u)
            positions += [n - u - v, n + u - v, n + u + v, n - u + v]
            normals += [n] * 4
    first = 4 * np.arange(6)[:, None]
    corners = np.array(positions) * size
    return Shape(
        corners,
        np.array(normals),
        np.concatenate([first + [0, 1, 2], first + [0, 2, 3]]),
        corners[:, :2],
    )


def _height_field(model: mujoco.MjModel, field: int) -> Shape:
    """The top surface, with a skirt down to the base as MuJoCo draws it."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    start = int(model.hfield_adr[field])
    x_half, y_half, top, base = model.hfield_size[field]
    z = top * model.hfield_data[start : start + rows * columns].reshape(rows, columns).astype(float)
    x, y = np.linspace(-x_half, x_half, columns), np.linspace(-y_half, y_half, rows)
    grid = np.stack([*np.meshgrid(x, y), z], -1)
    slope_y, slope_x = np.gradient(z, y, x)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(z)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    parts = [Shape(grid.reshape(-1, 3), normals.reshape(-1, 3), _grid_indices(rows, columns))]
    edges = ((grid[0], (0, -1)), (grid[:, -1], (1, 0)), (grid[-1, ::-1], (0, 1)), (grid[::-1, 0], (-1, 0)))
    for edge, (nx, ny) in edges:
        foot = edge.copy()
        foot[:, 2] = -base
        wall = np.concatenate([foot, edge])
        parts.append(Shape(wall, np.tile([nx, ny, 0.0], (len(wall), 1)), _grid_indices(2, len(edge))))
    offsets = np.cumsum([0] + [len(p.positions) for p in parts[:-1]])
    positions = np.concatenate([p.positions for p in parts])
    return Shape(
        positions,
        np.concatenate([p.normals for p in parts]),
        np.concatenate([p.indices + o for p, o in zip(parts, offsets, strict=True)]),
        positions[:, :2],
    )


def _mesh(model: mujoco.MjModel, mesh: int) -> Shape:
    def block(data: NDArray[np.generic], start: NDArray[np.integer], count: NDArray[np.integer]) -> Floats:
        return np.asarray(data[int(start[mesh]) : int(start[mesh]) + int(count[mesh])])

    vertices = block(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum).astype(float)
    faces = block(model.mesh_face, model.mesh_faceadr, model.mesh_facenum)
    normals = crease_normals(vertices, faces, _CREASE).reshape(-1, 3)
    columns = [vertices[faces.ravel()], normals]
    has_uv = model.mesh_texcoordadr[mesh] >= 0
    if has_uv:
        uv = block(model.mesh_texcoord, model.mesh_texcoordadr, model.mesh_texcoordnum)
        uv_faces = block(model.mesh_facetexcoord, model.mesh_faceadr, model.mesh_facenum)
        columns.append(uv[uv_faces.ravel()])
    corners = np.concatenate(columns, axis=1).astype(np.float32)
    unique, index = np.unique(corners, axis=0, return_inverse=True)
    return Shape(
        unique[:, :3], unique[:, 3:6], index.reshape(-1, 3), unique[:, 6:] if has_uv else unique[:, :2]
    )


def crease_normals(vertices: Floats, faces: NDArray[np.integer], crease: float) -> Floats:
    """A unit normal for each corner of each face (m, 3, 3): smooth, except across edges sharper than `crease`.

    Every corner averages, weighted by area, the faces round its vertex whose normals differ from its own
    face's by less than `crease` (rad). Vertices at one place count as one, as STL files repeat them.
    """
    _, place = np.unique(vertices.astype(np.float32), axis=0, return_inverse=True)
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    area_normal = np.cross(b - a, c - a)
    length = np.linalg.norm(area_normal, axis=1, keepdims=True)
    unit = np.divide(area_normal, length, out=np.zeros_like(area_normal), where=length > 0)
    corner_vertex = place.ravel()[faces.ravel()]
    order = np.argsort(corner_vertex, kind="stable")
    sorted_vertex = corner_vertex[order]
    face = order // 3
    total = area_normal[face].copy()
    # Pair each corner with the k-th next and k-th previous corner of the same vertex, for k = 1, 2, ...
    for step in range(1, int(np.bincount(corner_vertex).max())):
        here = np.flatnonzero(sorted_vertex[:-step] == sorted_vertex[step:])
        there = here + step
        smooth = np.einsum("ij,ij->i", unit[face[here]], unit[face[there]]) > np.cos(crease)
        here, there = here[smooth], there[smooth]
        total[here] += area_normal[face[there]]
        total[there] += area_normal[face[here]]
    norm = np.linalg.norm(total, axis=1, keepdims=True)
    total = np.divide(total, norm, out=np.tile([0.0, 0, 1], (len(total), 1)), where=norm > 0)
    normals = np.empty_like(total)
    normals[order] = total
    return normals.reshape(-1, 3, 3)
