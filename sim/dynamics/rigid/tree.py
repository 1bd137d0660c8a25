"""The kinematic tree of a model, one link per joint, in frames that leave as many zeros as possible.

Hinges turn about their own z axis and are reached from the parent's frame by Rz(phi) Rx(alpha), the classic
Denavit-Hartenberg pair; slides keep their parent's orientation. Bodies without a joint are merged into the
link that carries them; what hangs on the world is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import atan2, cos, hypot, pi, sin

import mujoco
import numpy as np

from ...compile.graph import Node, Scalar
from ..fields import Fields
from .spatial import Matrix, Vector, zeros

FREE, BALL, SLIDE, HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{k}")) for k in ("FREE", "BALL", "SLIDE", "HINGE")
)
DOFS = {FREE: 6, BALL: 3, SLIDE: 1, HINGE: 1}
COORDINATES = {FREE: 7, BALL: 4, SLIDE: 1, HINGE: 1}
_SNAP = 1e-14


def snap(x: Scalar) -> Scalar:
    """`x` without the rounding that would spoil an exact 0, 1 or -1."""
    if isinstance(x, Node):
        return x
    if abs(x) < _SNAP:
        return 0.0
    return float(round(x)) if abs(abs(x) - 1.0) < _SNAP else float(x)


@dataclass
class Pose:
    """A constant pose: rotation (numbers) and translation (numbers or symbols)."""

    R: np.ndarray
    p: Vector

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.R @ other.R, self.apply(other.p))

    def apply(self, p: Vector) -> Vector:
        """The point `p` in the outer frame."""
        return [
            sum((float(self.R[i, k]) * p[k] for k in range(3) if self.R[i, k] != 0.0), 0.0) + self.p[i]
            for i in range(3)
        ]

    def inverse(self) -> Pose:
        """The inverse pose."""
        turned = Pose(self.R.T, zeros()).apply(self.p)
        return Pose(self.R.T, [-x for x in turned])


@dataclass
class Inertia:
    """Mass, first moment and second moment (integral of x x^T) about the origin of a frame."""

    m: Scalar = 0.0
    h: Vector = field(default_factory=zeros)
    J: Matrix = field(default_factory=lambda: [zeros() for _ in range(3)])

    def moved(self, pose: Pose) -> Inertia:
        """The same matter seen from the outer frame of `pose`."""
        R, p = pose.R, pose.p
        h = Pose(R, zeros()).apply(self.h)
        left = [Pose(R, zeros()).apply([self.J[i][j] for i in range(3)]) for j in range(3)]  # columns of R J
        J = [Pose(R, zeros()).apply([left[j][i] for j in range(3)]) for i in range(3)]
        moved = [
            [J[i][j] + h[i] * p[j] + p[i] * h[j] + self.m * p[i] * p[j] for j in range(3)] for i in range(3)
        ]
        return Inertia(self.m, [x + self.m * y for x, y in zip(h, p, strict=True)], moved)

    def __add__(self, other: Inertia) -> Inertia:
        return Inertia(
            self.m + other.m,
            [x + y for x, y in zip(self.h, other.h, strict=True)],
            [[x + y for x, y in zip(a, b, strict=True)] for a, b in zip(self.J, other.J, strict=True)],
        )

    def snapped(self, like: Inertia) -> Inertia:
        """Without entries that are rounding of zero beside the matter `like`."""
        moments = [_size(like.J[k][k]) for k in range(3)]
        lever = max([_size(x) for x in like.h] + [(_size(like.m) * max(moments)) ** 0.5])
        J = [[_tiny(x, max(moments)) for x in row] for row in self.J]
        return Inertia(self.m, [_tiny(x, lever) for x in self.h], J)

    def rotational(self) -> Matrix:
        """Moments of inertia about the origin: tr(J) 1 - J."""
        J = self.J
        return [
            [J[1][1] + J[2][2], -J[0][1], -J[0][2]],
            [-J[0][1], J[0][0] + J[2][2], -J[1][2]],
            [-J[0][2], -J[1][2], J[0][0] + J[1][1]],
        ]


def _size(x: Scalar) -> float:
    return 0.0 if isinstance(x, Node) else abs(x)


def _tiny(x: Scalar, unit: float) -> Scalar:
    return x if isinstance(x, Node) or abs(x) > 1e-15 * unit else 0.0


@dataclass
class Link:
    """A joint and the matter that moves with it.

    `X` is the pose of the joint's frame in the parent's link frame. A hinge's rotation in `X` is kept as
    angles `phi` (about z) and `alpha` (about x), followed by q + `offset` about z. `qadr`, `dadr` are
    addresses in the model's qpos and qvel.
    """

    parent: int
    joint: int
    kind: int
    qadr: int
    dadr: int
    X: Pose
    axis: Vector = field(default_factory=zeros)
    phi: float = 0.0
    alpha: float = 0.0
    offset: float = 0.0
    bodies: dict[int, Pose] = field(default_factory=dict)
    children: list[int] = field(default_factory=list)
    inertia: Inertia = field(default_factory=Inertia)
    regrouped: Inertia = field(default_factory=Inertia)

    @property
    def ndof(self) -> int:
        """Degrees of freedom."""
        return DOFS[self.kind]


@dataclass
class Tree:
    """Links in topological order; for every body the link that carries it (-1: the world) and its pose."""

    links: list[Link]
    body_link: list[int]
    body_pose: list[Pose]


def _rotation(quat: np.ndarray) -> np.ndarray:
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, np.asarray(quat, float))
    return R.reshape(3, 3)


def quaternion_of_rotation(R: np.ndarray) -> list[float]:
    """Quaternion wxyz of a rotation matrix."""
    q = np.zeros(4)
    mujoco.mju_mat2Quat(q, np.ascontiguousarray(R).ravel())
    return [float(snap(float(x))) for x in q]


def _z_along(axis: np.ndarray) -> np.ndarray:
    """A rotation whose z column is `axis`: a permutation with signs where possible."""
    a = np.asarray(axis, float) / np.linalg.norm(axis)
    x = np.zeros(3)
    x[(int(np.argmax(abs(a))) + 1) % 3] = 1.0
    x -= a * (a @ x)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(a, x), a])


def _rz(t: float) -> np.ndarray:
    return np.array([[cos(t), -sin(t), 0.0], [sin(t), cos(t), 0.0], [0.0, 0.0, 1.0]])


def _rx(t: float) -> np.ndarray:
    return np.array([[1.0, 0.0, 0.0], [0.0, cos(t), -sin(t)], [0.0, sin(t), cos(t)]])


def build_tree(fields: Fields) -> Tree:
    """The tree of `fields.model` with inertias, regrouped inertias and chosen frames."""
    model = fields.model
    links: list[Link] = []
    body_link, body_pose = [-1], [Pose(np.eye(3), zeros())]
    for body in range(1, model.nbody):
        parent = body_link[model.body_parentid[body]]
        C = body_pose[model.body_parentid[body]] @ Pose(
            _rotation(model.body_quat[body]), fields.vector("body_pos", body)
        )
        first = model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            link, C = _link_of_joint(model, joint, parent, C)
            links.append(link)
            parent = len(links) - 1
        body_link.append(parent)
        body_pose.append(C)
    for index, link in enumerate(links):
        if link.parent >= 0:
            links[link.parent].children.append(index)
    for body in range(1, model.nbody):
        if body_link[body] >= 0:
            links[body_link[body]].bodies[body] = body_pose[body]
    _choose_frames(links)
    for link in links:
        for body, pose in link.bodies.items():
            body_pose[body] = pose
            link.inertia = link.inertia + _body_inertia(fields, body).moved(pose)
        link.inertia = link.inertia.snapped(link.inertia)
    _regroup(links)
    return Tree(links, body_link, body_pose)


def _link_of_joint(model: mujoco.MjModel, joint: int, parent: int, C: Pose) -> tuple[Link, Pose]:
    """The link behind `joint` of a body at `C` in the parent's link, and the body's pose in the new link."""
    kind = int(model.jnt_type[joint])
    qadr, dadr = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    link = Link(parent, joint, kind, qadr, dadr, Pose(np.eye(3), zeros()))
    if kind == FREE:
        return link, Pose(np.eye(3), zeros())
    if kind == SLIDE:
        link.X = Pose(np.eye(3), C.p)
        link.axis = [snap(float(x)) for x in C.R @ model.jnt_axis[joint]]
        link.X.p = [p - float(model.qpos0[qadr]) * a for p, a in zip(C.p, link.axis, strict=True)]
        return link, Pose(C.R, zeros())
    anchor: Vector = [float(x) for x in model.jnt_pos[joint]]
    A = Pose(_z_along(model.jnt_axis[joint]) if kind == HINGE else np.eye(3), anchor)
    link.X = C @ A
    if kind == HINGE:
        link.offset = -float(model.qpos0[qadr])
    return link, A.inverse()


def _body_inertia(fields: Fields, body: int) -> Inertia:
    """Inertia of one body in its own frame: J = R diag(tr(I)/2 - I) R^T + m c c^T."""
    m = fields.scalar("body_mass", body)
    moments = fields.vector("body_inertia", body)
    half = 0.5 * (moments[0] + moments[1] + moments[2])
    J = [zeros() for _ in range(3)]
    for k in range(3):
        J[k][k] = half - moments[k]
    pose = Pose(_rotation(fields.model.body_iquat[body]), fields.vector("body_ipos", body))
    return Inertia(m, zeros(), J).moved(pose)


def _zx(R: np.ndarray) -> tuple[float, float]:
    """(phi, alpha) with R = Rz(phi) Rx(alpha) Rz(.), |phi| <= 90 degrees."""
    sine = hypot(R[0, 2], R[1, 2])
    if sine < 1e-13:
        return 0.0, (0.0 if R[2, 2] > 0 else pi)
    alpha, phi = atan2(sine, R[2, 2]), atan2(R[0, 2], -R[1, 2])
    if abs(phi) > pi / 2 + 1e-9:
        return phi - pi if phi > 0 else phi + pi, -alpha
    return phi, alpha


def _choose_frames(links: list[Link]) -> None:
    """Turn and shift every hinge's frame about its axis so that constant rotations and offsets vanish."""
    turned = [_common_normal(link) if link.kind == HINGE else 0.0 for link in links]
    moves: list[Pose] = []
    for index, link in enumerate(links):
        if link.kind != HINGE:  # a slide keeps its parent's orientation
            follows = link.kind == SLIDE and link.parent >= 0
            moves.append(Pose(moves[link.parent].R if follows else np.eye(3), zeros()))
            continue
        primary = next((c for c in link.children if links[c].kind == HINGE), None)
        shift = _shift(link, turned[index], links)
        if (
            link.parent < 0 and primary is not None
        ):  # the first hinge may stand level with the second's normal
            child = links[primary]
            shift = child.X.p[2] + float(child.X.R[2, 2]) * _shift(child, turned[primary], links)
        moves.append(Pose(_rz(0.0 if primary is None else turned[primary]), [0.0, 0.0, shift]))
    for index, link in enumerate(links):
        base = moves[link.parent].inverse() if link.parent >= 0 else Pose(np.eye(3), zeros())
        link.X = base @ link.X @ moves[index]
        link.X.p = _snapped(link.X.p)
        link.axis = [snap(x) for x in Pose(base.R, zeros()).apply(link.axis)]
        link.bodies = {body: moves[index].inverse() @ pose for body, pose in link.bodies.items()}
        if link.kind == HINGE:
            link.phi, link.alpha = _zx(link.X.R)
            rest = (_rz(link.phi) @ _rx(link.alpha)).T @ link.X.R
            link.offset += atan2(rest[1, 0], rest[0, 0])


def _snapped(p: Vector) -> Vector:
    unit = max(_size(x) for x in p)
    return [_tiny(x, unit) for x in p]


def _common_normal(link: Link) -> float:
    """Angle about the parent's z axis of the common normal with the hinge's axis."""
    phi, alpha = _zx(link.X.R)
    p = link.X.p
    if abs(sin(alpha)) > 1e-13 or any(isinstance(x, Node) for x in p):
        return phi
    phi = atan2(p[1], p[0])
    return phi - pi * round(phi / pi) if abs(phi) > pi / 2 + 1e-9 else phi


def _shift(link: Link, phi: float, links: list[Link]) -> Scalar:
    """Move of a hinge's origin along its axis: onto the common normal with the parent's axis where that is
    well defined (nearly parallel axes meet far away: left alone), or level with the parent's origin."""
    if link.parent < 0:
        return 0.0
    p, axis = link.X.p, link.X.R[:, 2]
    if links[link.parent].kind != HINGE:
        k = int(np.argmax(abs(axis)))
        return p[k] * (-1.0 / float(axis[k]))
    sine = hypot(axis[0], axis[1])
    if sine > 0.1:
        across = -sin(phi) * p[0] + cos(phi) * p[1]
        return across * (1.0 / float(-(-sin(phi) * axis[0] + cos(phi) * axis[1])))
    return p[2] * (-float(np.sign(axis[2]))) if sine < 1e-13 else 0.0


def _regroup(links: list[Link]) -> None:
    """Hand matter whose place a joint does not change to the parent: exact, and it leaves zeros.

    What lies on a hinge's axis (all of m, h_z and J_zz), the second moment behind a slide, the mass at a
    ball's centre (base parameters: Khalil & Dombre, Modeling, Identification and Control of Robots, ch. 9).
    """
    for link in links:
        link.regrouped = link.inertia
    for link in reversed(links):
        own = link.regrouped
        if link.kind == HINGE:
            J = [list(row) for row in own.J]
            Jzz, J[2][2] = J[2][2], 0.0
            given = Inertia(own.m, [0.0, 0.0, own.h[2]], [zeros(), zeros(), [0.0, 0.0, Jzz]])
            kept = Inertia(0.0, [own.h[0], own.h[1], 0.0], J)
        elif link.kind == SLIDE:
            given, kept = Inertia(J=own.J), Inertia(own.m, own.h)
        elif link.kind == BALL:
            given, kept = Inertia(own.m), Inertia(0.0, own.h, own.J)
        else:
            continue
        link.regrouped = kept.snapped(own)
        if link.parent >= 0:
            parent = links[link.parent]
            whole = parent.regrouped + given.moved(link.X)
            parent.regrouped = whole.snapped(whole)
