"""Triangles, normals and texture coordinates of every MuJoCo geom type, in the geom's frame."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]

SEGMENTS = 96  # round the axis of a curved shape: surfaces true to 0.1 % of the radius
_CREASE = np.deg2rad(25.0)  # faces that meet at a sharper angle are shaded apart


@dataclass(frozen=True)
class Shape:
    """A triangle surface: positions (n, 3), normals (n, 3), uv (n, 2) or None, indices (m, 3)."""

    positions: Floats
    normals: Floats
    indices: NDArray[np.integer]
    uv: Floats | None = None


def geom_shape(
    model: mujoco.MjModel, geom: int, *, plane_radius: float, segments: int = SEGMENTS
) -> Shape | None:
    """The surface of a geom in its own frame, or None for a type that has none.

    A plane's infinite directions (size 0) end at `plane_radius` metres. Primitives carry MuJoCo's texture
    coordinates, once over each face or round the shape; meshes their own where they have them. Curved
    primitives have `segments` (a multiple of 4) sides round the axis, half as many from pole to pole.
    """
    kind = mujoco.mjtGeom(model.geom_type[geom])
    size = model.geom_size[geom]
    data = int(model.geom_dataid[geom])
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_PLANE:
        return _plane(size[:2], plane_radius)
    if kind == types.mjGEOM_SPHERE:
        return _ellipsoid(np.full(3, size[0]), segments)
    if kind == types.mjGEOM_ELLIPSOID:
        return _ellipsoid(size, segments)
    if kind == types.mjGEOM_CAPSULE:
        return _capsule(size[0], size[1], segments)
    if kind == types.mjGEOM_CYLINDER:
        return _cylinder(size[0], size[1], segments)
    if kind == types.mjGEOM_BOX:
        return _box(size)
    if kind == types.mjGEOM_HFIELD and data >= 0:
        return _height_field(model, data)
    if kind in (types.mjGEOM_MESH, types.mjGEOM_SDF) and data >= 0:
        return _mesh(model, data)
    return None


def _plane(size: Floats, radius: float) -> Shape:
    unit = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    corners = unit * np.where(size > 0, size, radius)
    down = np.array([1, -1])  # images begin at the top; without an end, one image covers two metres
    uv = np.where(size > 0, (unit * down + 1) / 2, corners * down / 2)
    flat = np.column_stack([corners, np.zeros(4)])
    return Shape(flat, np.tile([0.0, 0, 1], (4, 1)), np.array([[0, 1, 2], [0, 2, 3]]), uv)


def _grid_indices(rows: int, columns: int) -> NDArray[np.integer]:
    """Two triangles, counterclockwise from outside, for each cell of a grid of rows x columns vertices."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (row * columns + column).ravel()
    b, c, d = a + 1, a + columns + 1, a + columns
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _revolved(r: Floats, z: Floats, normal_r: Floats, normal_z: Floats, v: Floats, segments: int) -> Shape:
    """A profile, from bottom to top, turned about z; `v` (one a ring) is its texture coordinate."""
    turn = np.linspace(0, 1, segments + 1)
    cosine, sine = np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)

    def turned(r: Floats, z: Floats) -> Floats:
        around = np.broadcast_to(z[:, None], (len(r), len(turn)))
        return np.stack([np.outer(r, cosine), np.outer(r, sine), around], -1).reshape(-1, 3)

    uv = np.stack([np.tile(turn, len(r)), np.repeat(v, len(turn))], axis=1)
    return Shape(turned(r, z), turned(normal_r, normal_z), _grid_indices(len(r), len(turn)), uv)


def _ellipsoid(size: Floats, segments: int) -> Shape:
    latitude = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    r, z = np.cos(latitude), np.sin(latitude)
    unit = _revolved(r, z, r, z, 0.5 - latitude / np.pi, segments)
    normals = unit.positions / size
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Shape(unit.positions * size, normals, unit.indices, unit.uv)


def _capsule(radius: float, half: float, segments: int) -> Shape:
    latitude = np.linspace(0, np.pi / 2, segments // 4 + 1)
    below, above = -latitude[::-1], latitude
    # Each hemisphere and the barrel between them carry the whole image, so the rims come twice.
    angle = np.concatenate([below, [0.0, 0.0], above])
    r, z = np.cos(angle), np.sin(angle)
    shift = np.concatenate([np.full(len(below) + 1, -half), np.full(len(above) + 1, half)])
    v = np.concatenate([-2 * below / np.pi, [1.0, 0.0], 1 - 2 * above / np.pi])
    return _revolved(radius * r, radius * z + shift, r, z, v, segments)


def _cylinder(radius: float, half: float, segments: int) -> Shape:
    r = np.array([0.0, radius, radius, radius, radius, 0.0])
    z = half * np.array([-1.0, -1, -1, 1, 1, 1])
    normal_r, normal_z = np.array([0.0, 0, 1, 1, 0, 0]), np.array([-1.0, -1, 0, 0, 1, 1])
    whole = _revolved(r, z, normal_r, normal_z, (1 - z / half) / 2, segments)
    lids = np.abs(whole.normals[:, 2:]) > 0.5
    uv = np.where(lids, 0.5 + whole.positions[:, :2] / (2 * radius), np.asarray(whole.uv))
    return Shape(whole.positions, whole.normals, whole.indices, uv)


def _box(size: Floats) -> Shape:
    positions, normals, uv = [], [], []
    for axis, (across, up) in enumerate(((1, 2), (0, 2), (0, 1))):
        for sign in (-1.0, 1.0):
            n, a = np.zeros(3), np.zeros(3)
            n[axis], a[(axis + 1) % 3] = sign, 1.0
            b = np.cross(n, a)
            face = [n - a - b, n + a - b, n + a + b, n - a + b]
            positions += face
            normals += [n] * 4
            uv += [((corner[across] + 1) / 2, (1 - corner[up]) / 2) for corner in face]
    first = 4 * np.arange(6)[:, None]
    indices = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return Shape(np.array(positions) * size, np.array(normals), indices, np.array(uv))


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
        (positions[:, :2] / [x_half, y_half] * [1, -1] + 1) / 2,
    )


def _mesh(model: mujoco.MjModel, mesh: int) -> Shape:
    def block(data: Any, start: Any, count: Any) -> NDArray[Any]:
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
    """A unit normal for each corner of each face (m, 3, 3): smooth but across edges sharper than `crease`.

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
    normals: Floats = np.empty_like(total)
    normals[order] = total
    return normals.reshape(-1, 3, 3)


def levels(model: mujoco.MjModel, geom: int, shape: Shape, *, pixel: float) -> list[tuple[float, Shape]]:
    """Coarser forms of a geom's surface, each with how far (m) it may stray from it, finest first.

    Curved primitives get fewer sides; meshes are merged over cells of about a `pixel` (m). A form is kept
    only when it saves a third of the triangles.
    """
    types = mujoco.mjtGeom
    kind = int(model.geom_type[geom])
    found: list[tuple[float, Shape]] = []
    if kind in (types.mjGEOM_SPHERE, types.mjGEOM_CAPSULE, types.mjGEOM_CYLINDER, types.mjGEOM_ELLIPSOID):
        radius = float(model.geom_size[geom][: 3 if kind == types.mjGEOM_ELLIPSOID else 1].max())
        for segments in (48, 24, 12):
            simple = geom_shape(model, geom, plane_radius=1.0, segments=segments)
            assert simple is not None
            found.append((2 * radius * (1 - float(np.cos(np.pi / segments))), simple))
    elif kind in (types.mjGEOM_MESH, types.mjGEOM_SDF):
        least = len(shape.indices)
        for cell in (0.35 * pixel, 0.7 * pixel, 1.4 * pixel):
            simple = coarse(shape, cell)
            if 0 < len(simple.indices) < 0.7 * least:
                found.append((0.5 * cell, simple))
                least = len(simple.indices)
    return found


def coarse(shape: Shape, cell: float) -> Shape:
    """The surface with vertices that share a cell of a grid of width `cell` (m) merged into their mean.

    Vertices whose normals differ much keep apart in shading, not in place, so edges stay sharp. Triangles
    that shrink to a line vanish. (Vertex clustering: Rossignac and Borrel, 1993.)
    """
    _, place = np.unique(np.floor(shape.positions / cell).astype(np.int64), axis=0, return_inverse=True)
    place = place.ravel()
    facing = np.round(1.5 * shape.normals).astype(np.int64) @ [9, 3, 1]
    _, first, merged = np.unique(
        np.stack([place, facing], axis=1), axis=0, return_index=True, return_inverse=True
    )
    merged = merged.ravel()

    def mean(values: Floats, label: NDArray[np.integer]) -> Floats:
        sums = [np.bincount(label, weights=values[:, axis]) for axis in range(values.shape[1])]
        return np.stack(sums, axis=1) / np.bincount(label)[:, None]

    positions = mean(shape.positions, place)[place[first]]
    normals = mean(shape.normals, merged)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), shape.normals[first])
    corners = place[shape.indices]
    whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    uv = None if shape.uv is None else mean(shape.uv, merged)
    return Shape(positions, normals, merged[shape.indices[whole]], uv)
