"""Questions of inverse kinematics whose answer is known by construction, never from a solver.

Each family is a function of a random generator that gives a Case.
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np
from pantograph.sim.ik import Distance, JointValue, Orientation, PointOnLine, PointOnPlane, Pose, Position

from . import ik_planar as planar

HINGE, SLIDE, BALL = (getattr(mujoco.mjtJoint, f"mjJNT_{k}") for k in ("HINGE", "SLIDE", "BALL"))


class Case(NamedTuple):
    """A question and its true answer.

    `distance` is how far out of reach (None: not part of the truth), `joints` sets of joints of which one
    must be named, `goals` the labels that must be named; `q` a solution when there is one.
    """

    family: str
    model: mujoco.MjModel
    goals: list[Any]
    kind: str
    distance: float | None = None
    rotation: float | None = None
    joints: tuple[frozenset[str], ...] = ()
    labels: frozenset[str] = frozenset()
    q: np.ndarray | None = None


def chain(links, *, base=(0, 0, 0), branches=()):
    """A model of links (offset, joint type, axis, range or None), each hung on the one before; site `tip`.

    `branches`: further chains from the world, with sites `tip1`, ...
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    for k, group in enumerate([links, *branches]):
        body, suffix = spec.worldbody, str(k) if k else ""
        for i, (offset, kind, axis, limits) in enumerate(group):
            body = body.add_body(name=f"link{suffix}_{i}", pos=np.add(offset, base) if i == 0 else offset)
            if kind is not None:
                joint = body.add_joint(name=f"j{suffix}{i}", type=kind, axis=axis)
                if limits is not None:
                    joint.range, joint.limited = limits, True
            body.add_geom(size=[0.01, 0, 0], mass=1, contype=0, conaffinity=0)
            if i and not k:
                body.add_site(name=f"at{i}")
        body.add_site(name=f"tip{suffix}")
    return spec.compile()


def planar_chain(lengths, ranges=None, axis=(0, 0, 1)):
    """Planar arm in x-y with the last link's end as tip."""
    ranges = ranges or [None] * len(lengths)
    links = [([0, 0, 0] if i == 0 else [lengths[i - 1], 0, 0], HINGE, axis, r) for i, r in enumerate(ranges)]
    return chain([*links, ([lengths[-1], 0, 0], None, None, None)])


def unit(rng):
    x = rng.normal(size=3)
    return x / np.linalg.norm(x)


def quat_z(angle):
    return [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]


def pose_of(model, q, site):
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, data.site(site).xmat)
    return data.site(site).xpos.copy(), quat


# Reachable: the target is where a configuration within the limits puts it.


def _random_chain(rng, n):
    links = []
    for i in range(n):
        offset = rng.normal(size=3) * 0.3 if i else np.zeros(3)
        middle, half = rng.uniform(-1, 1), rng.uniform(0.5, 3.0)
        axis = np.eye(3)[rng.integers(3)] if rng.random() < 0.5 else unit(rng)
        links.append((offset, HINGE, axis, (middle - half, middle + half)))
    return chain([*links, (rng.normal(size=3) * 0.3, None, None, None)])


def _within(model, rng):
    low, high = model.jnt_range.T
    return rng.uniform(low, high)


def reachable_pose(rng):
    """Full pose of a random chain of three to seven hinges with random limits."""
    model = _random_chain(rng, int(rng.integers(3, 8)))
    q = _within(model, rng)
    p, quat = pose_of(model, q, "tip")
    return Case("pose of a chain", model, [Pose("tip", p, quat)], "solved", q=q)


def reachable_point(rng):
    """Point of a random chain of two to six hinges."""
    model = _random_chain(rng, int(rng.integers(2, 7)))
    q = _within(model, rng)
    return Case("point of a chain", model, [Position("tip", pose_of(model, q, "tip")[0])], "solved", q=q)


def reachable_at_limit(rng):
    """Pose at a configuration with joints exactly at their limits."""
    model = _random_chain(rng, 6)
    q = _within(model, rng)
    k = rng.permutation(6)[: rng.integers(1, 4)]
    q[k] = model.jnt_range[k, rng.integers(0, 2, len(k))]
    p, quat = pose_of(model, q, "tip")
    return Case("pose at limits", model, [Pose("tip", p, quat)], "solved", q=q)


def reachable_stretched(rng):
    """Rank-one boundary point: a planar arm stretched or folded out straight."""
    lengths = rng.uniform(0.2, 1.5, int(rng.integers(2, 5)))
    angle = rng.uniform(-np.pi, np.pi)
    p = sum(lengths) * np.array([np.cos(angle), np.sin(angle), 0])
    return Case("stretched arm", planar_chain(lengths), [Position("tip", p)], "solved")


def reachable_wrist(rng):
    """Pose with a singular spherical wrist: the fifth joint at zero."""
    ranges = [(-3.0, 3.0)] * 6
    z, y = (0, 0, 1), (0, 1, 0)
    axes = [z, y, y, z, y, z]
    offsets = [[0, 0, 0], [0, 0, 0.3], [0, 0, 0.4], [0, 0, 0.35], [0, 0, 0], [0, 0, 0]]
    links = [(o, HINGE, a, r) for o, a, r in zip(offsets, axes, ranges, strict=True)]
    model = chain([*links, ([0, 0, 0.1], None, None, None)])
    q = rng.uniform(-2, 2, 6)
    q[4] = 0
    p, quat = pose_of(model, q, "tip")
    return Case("singular wrist", model, [Pose("tip", p, quat)], "solved", q=q)


def reachable_several(rng):
    """Two arms on a turning trunk, both hands placed at once."""
    arm = [([0, 0.2, 0.1], HINGE, unit(rng), (-2, 2)), ([0.3, 0, 0], HINGE, unit(rng), (-2, 2)),
           ([0.25, 0, 0], HINGE, unit(rng), (-2, 2)), ([0.1, 0, 0], BALL, (0, 0, 1), (0, 1.0))]  # fmt: skip
    model = _trunk(arm)
    q = _tree_state(model, rng)
    goals = [Position(s, pose_of(model, q, s)[0]) for s in ("left", "right")]
    goals.append(Distance("left", "right", float(np.linalg.norm(goals[0].target - goals[1].target))))
    return Case("two hands", model, goals, "solved", q=q)


def _trunk(arm):
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    trunk = spec.worldbody.add_body(name="trunk")
    trunk.add_joint(name="waist", type=HINGE, axis=[0, 0, 1], range=[-1, 1], limited=True)
    trunk.add_geom(size=[0.05, 0, 0], mass=1, contype=0, conaffinity=0)
    for side, sign in (("left", 1), ("right", -1)):
        body = trunk
        for i, (offset, kind, axis, limits) in enumerate(arm):
            body = body.add_body(name=f"{side}{i}", pos=np.array(offset) * [1, sign, 1])
            joint = body.add_joint(name=f"{side}_{i}", type=kind, axis=axis)
            joint.range, joint.limited = limits, True
            body.add_geom(size=[0.01, 0, 0], mass=1, contype=0, conaffinity=0)
        body.add_site(name=side, pos=[0.1, 0, 0])
    return spec.compile()


def _tree_state(model, rng):
    q = model.qpos0.copy()
    for j in range(model.njnt):
        at = model.jnt_qposadr[j]
        if model.jnt_type[j] == BALL:
            angle, axis = rng.uniform(0, model.jnt_range[j, 1]), unit(rng)
            q[at : at + 4] = [np.cos(angle / 2), *(np.sin(angle / 2) * axis)]
        else:
            q[at] = rng.uniform(*model.jnt_range[j])
    return q


# Out of reach: by a distance that geometry gives.


def beyond_ring(rng):
    """A planar arm and a point outside its ring, or in its hole."""
    lengths = rng.uniform(0.2, 1.5, int(rng.integers(2, 5)))
    inner = max(0.0, 2 * max(lengths) - sum(lengths))
    far = sum(lengths) + rng.uniform(1e-3, 1.0)
    distance = rng.uniform(0, inner - 1e-3) if inner > 2e-3 and rng.random() < 0.5 else far
    angle, height = rng.uniform(-np.pi, np.pi), 0.0 if rng.random() < 0.7 else rng.uniform(-0.5, 0.5)
    p = [distance * np.cos(angle), distance * np.sin(angle), height]
    truth = float(np.hypot(planar.gap(lengths, distance), height))
    return Case("outside the ring", planar_chain(lengths), [Position("tip", p)], "out of reach", truth)


def beyond_plane(rng):
    """A planar arm and a point above its plane, over the ring."""
    lengths = rng.uniform(0.2, 1.0, int(rng.integers(2, 5)))
    tip = planar.forward(lengths, rng.uniform(-3, 3, len(lengths)))[-1]
    height = rng.choice([-1, 1]) * rng.uniform(1e-3, 0.5)
    goal = Position("tip", [*tip, height])
    return Case("above the plane", planar_chain(lengths), [goal], "out of reach", abs(height))


def beyond_sphere(rng):
    """Shoulder of three meeting axes or a ball, two bones, and a point beyond their length or in the hole."""
    a, b = rng.uniform(0.2, 1.0, 2)
    shoulder = rng.normal(size=3) * 0.3
    z, y, x = np.eye(3)[::-1]
    if rng.random() < 0.5:
        links = [([0, 0, 0], HINGE, z, None), ([0, 0, 0], HINGE, y, None), ([0, 0, 0], HINGE, x, None)]
    else:
        links = [([0, 0, 0], BALL, z, None)]
    model = chain([*links, ([a, 0, 0], HINGE, y, None), ([b, 0, 0], None, None, None)], base=shoulder)
    hole = abs(a - b)
    inside = hole > 2e-3 and rng.random() < 0.4
    distance = rng.uniform(0, hole - 1e-3) if inside else a + b + rng.uniform(1e-3, 1)
    truth = hole - distance if inside else distance - a - b
    goal = Position("tip", shoulder + distance * unit(rng))
    return Case("outside the sphere", model, [goal], "out of reach", float(truth))


def beyond_surface(rng):
    """Two bones from a ball joint, and a plane or a line farther away than they are long."""
    a, b = rng.uniform(0.2, 1.0, 2)
    shoulder, gap, normal = rng.normal(size=3) * 0.3, rng.uniform(1e-3, 1), unit(rng)
    links = [
        ([0, 0, 0], BALL, (0, 0, 1), None),
        ([a, 0, 0], HINGE, (0, 1, 0), None),
        ([b, 0, 0], None, None, None),
    ]
    aside = np.cross(normal, unit(rng))
    point = shoulder + (a + b + gap) * normal + aside * rng.normal()
    goal = PointOnPlane("tip", point, normal) if rng.random() < 0.5 else PointOnLine("tip", point, aside)
    return Case("beyond a surface", chain(links, base=shoulder), [goal], "out of reach", float(gap))


def beyond_tilt(rng):
    """A planar arm asked for a tilted orientation: the tilt of its axis remains."""
    lengths = rng.uniform(0.2, 1.0, int(rng.integers(2, 5)))
    tilt, about, spin = rng.uniform(0.01, 3.0), rng.uniform(-np.pi, np.pi), rng.uniform(-np.pi, np.pi)
    turn = np.empty(4)
    axis = [np.cos(about), np.sin(about), 0]
    mujoco.mju_mulQuat(turn, np.array([np.cos(tilt / 2), *np.multiply(np.sin(tilt / 2), axis)]), quat_z(spin))
    goal = Orientation("tip", turn)
    return Case("tilted", planar_chain(lengths), [goal], "out of reach", rotation=tilt)


def beyond_slides(rng):
    """A gantry of three slides and a point beyond its box."""
    ranges = np.sort(rng.uniform(-1, 1, (3, 2)), axis=1)
    model = chain([*[([0, 0, 0], SLIDE, e, r) for e, r in zip(np.eye(3), ranges, strict=True)],
                   ([0.1, 0.2, 0.3], None, None, None)])  # fmt: skip
    p = np.array([0.1, 0.2, 0.3]) + rng.uniform(ranges[:, 0], ranges[:, 1])
    k = rng.integers(3)
    p[k] = (0.1, 0.2, 0.3)[k] + ranges[k, 1] + rng.uniform(1e-3, 1)
    return Case("beyond the gantry", model, [Position("tip", p)], "held by limits",
                joints=(frozenset([f"j{k}"]),), distance=None)  # fmt: skip


def beyond_heading(rng):
    """A planar 3R arm to a place in reach with a heading that leaves the wrist beyond the two bones."""
    lengths = rng.uniform(0.3, 1.0, 3)
    bones, hand = lengths[0] + lengths[1], lengths[2]
    far, turn = rng.uniform(0.8 * bones, bones + 0.95 * hand), rng.uniform(-3, 3)
    distance, rotation = _apart(bones, hand, far, abs(turn))
    if min(distance, rotation) < 1e-3:
        return beyond_heading(rng)
    angle = rng.uniform(-np.pi, np.pi)
    goal = Pose("tip", [far * np.cos(angle), far * np.sin(angle), 0], quat_z(angle + turn))
    return Case("heading apart", planar_chain(lengths), [goal], "out of reach", distance, rotation)


def beyond_wrist(rng):
    """A wrist arm to a place in reach with an orientation that leaves its wrist beyond its two bones."""
    height, upper, fore, hand = rng.uniform([0.1, 0.3, 0.3, 0.05], [0.4, 0.6, 0.6, 0.2])
    z, y = (0, 0, 1), (0, 1, 0)
    ups = [0, height, upper, fore, 0, 0]
    links = [([0, 0, up], HINGE, axis, None) for up, axis in zip(ups, [z, y, y, z, y, z], strict=True)]
    far, turn, way = upper + fore + rng.uniform(-0.7, 0.9) * hand, rng.uniform(0.1, 3), unit(rng)
    distance, rotation = _apart(upper + fore, hand, far, turn)
    if min(distance, rotation) < 1e-3:
        return beyond_wrist(rng)
    aside = np.cross(way, unit(rng))
    along = np.cos(turn) * way + np.sin(turn) * aside / np.linalg.norm(aside)  # of the hand
    across = np.cross(along, unit(rng))
    across /= np.linalg.norm(across)
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.column_stack([across, np.cross(along, across), along]).ravel())
    goal = Pose("tip", far * way, quat)
    model = chain([*links, ([0, 0, hand], None, None, None)], base=(0, 0, -height))
    return Case("wrist apart", model, [goal], "out of reach", distance, rotation)


def _apart(bones, hand, far, turn):
    """How far a hand at `far`, turned by `turn` from the way there, leaves its wrist beyond the bones.

    And how far it must turn back until they reach.
    """
    distance = np.sqrt(far**2 + hand**2 - 2 * far * hand * np.cos(turn)) - bones
    cosine = (far**2 + hand**2 - bones**2) / (2 * far * hand)
    return float(distance), float(turn - np.arccos(np.clip(cosine, -1, 1))) if cosine < 0.999 else 0.0


# Held by limits: all solutions are known, and limits exclude each of them.


def limited_two_links(rng):
    """A planar 2R arm whose two solutions are both outside the limits of some joint."""
    lengths = rng.uniform(0.3, 1.2, 2)
    q = np.array([rng.uniform(-1.5, 1.5), rng.choice([-1, 1]) * rng.uniform(0.3, 2.8)])
    both = planar.two_links(lengths, planar.forward(lengths, q)[-1])
    ranges, named = _excluding(rng, both)
    goal = Position("tip", [*planar.forward(lengths, q)[-1], 0])
    return Case("2R within limits", planar_chain(lengths, ranges), [goal], "held by limits", joints=named)


def limited_three_links(rng):
    """A planar 3R arm to a pose, both solutions outside the limits."""
    lengths = rng.uniform(0.3, 1.2, 3)
    q = np.array([rng.uniform(-1.0, 1.0), rng.choice([-1, 1]) * rng.uniform(0.3, 2.5), rng.uniform(-1, 1)])
    tip, heading = planar.forward(lengths, q)[-1], q.sum()
    both = planar.three_links_pose(lengths, tip, heading)
    ranges, named = _excluding(rng, both)
    goal = Pose("tip", [*tip, 0], quat_z(heading))
    return Case("3R within limits", planar_chain(lengths, ranges), [goal], "held by limits", joints=named)


def _excluding(rng, solutions):
    """Ranges that every solution (k, n) violates in some joint by more than 0.02 rad, and the joints."""
    n = solutions.shape[1]
    ranges = [(-np.pi, np.pi)] * n
    named = []
    for s in solutions:
        if any(s[j] < ranges[j][0] - 0.02 or s[j] > ranges[j][1] + 0.02 for j in range(n)):
            continue
        j = int(rng.integers(n))
        margin = rng.uniform(0.03, 0.4)
        low, high = ranges[j]
        ranges[j] = (low, s[j] - margin) if s[j] - margin > low + 0.1 else (s[j] + margin, high)
    for s in solutions:
        out = [f"j{j}" for j in range(n) if s[j] < ranges[j][0] or s[j] > ranges[j][1]]
        named.append(frozenset(out))
    return ranges, tuple(named)


def limited_elbow(rng):
    """Two bones whose elbow cannot bend, or stretch, as far as the point needs (law of cosines)."""
    a, b = rng.uniform(0.3, 1.0, 2)
    low, high = sorted(rng.uniform(0.1, 2.9, 2))
    high = max(high, low + 0.2)
    bend = (
        rng.uniform(0.02, low - 0.03) if low > 0.1 and rng.random() < 0.5 else rng.uniform(high + 0.03, 3.1)
    )
    distance = np.sqrt(a * a + b * b + 2 * a * b * np.cos(bend))
    z, y = (0, 0, 1), (0, 1, 0)
    links = [([0, 0, 0], BALL, z, None), ([a, 0, 0], HINGE, y, (low, high)), ([b, 0, 0], None, None, None)]
    edge = low if bend < low else high
    truth = abs(np.sqrt(a * a + b * b + 2 * a * b * np.cos(edge)) - distance)
    goal = Position("tip", distance * unit(rng))
    return Case("elbow", chain(links), [goal], "held by limits", float(truth), joints=(frozenset(["j1"]),))


def limited_value(rng):
    """A joint asked for a value beyond its range."""
    model = _random_chain(rng, int(rng.integers(1, 6)))
    j = int(rng.integers(model.njnt))
    value = float(model.jnt_range[j, 1] + rng.uniform(1e-3, 2))
    goals = [JointValue(f"j{j}", value)]
    return Case("joint value", model, goals, "held by limits", joints=(frozenset([f"j{j}"]),))


def limited_point(rng):
    """A planar arm of two to four narrow joints and a point in its ring, farther from its area than 0.1 m."""
    lengths = rng.uniform(0.3, 1.2, int(rng.integers(2, 5)))
    ranges = [(low, low + rng.uniform(0.2, 2.2)) for low in rng.uniform(-2.5, 0.3, len(lengths))]
    tip = planar.forward(lengths, rng.uniform(-np.pi, np.pi, len(lengths)))[-1]
    grid = np.meshgrid(*(np.linspace(*r, 13) for r in ranges))
    angles = np.cumsum(np.stack([x.ravel() for x in grid], axis=1), axis=1)
    seen = np.abs(np.exp(1j * angles) @ lengths - complex(*tip)).min()
    if seen < 0.3:
        return limited_point(rng)
    distance = planar.nearest_within(lengths, ranges, tip)
    assert 0.1 < distance <= seen + 1e-12
    goal = Position("tip", [*tip, 0])
    return Case("point within limits", planar_chain(lengths, ranges), [goal], "held by limits", distance)


def limited_direction(rng):
    """One hinge turned beyond its range to point the tip."""
    half = rng.uniform(0.2, 1.5)
    turn = half + rng.uniform(0.02, 1.4)
    length = rng.uniform(0.1, 1.0)
    model = planar_chain([length], [(-half, half)])
    if rng.random() < 0.5:
        goal = Position("tip", [length * np.cos(turn), length * np.sin(turn), 0])
    else:
        goal = Orientation("tip", quat_z(turn))
    return Case("one hinge", model, [goal], "held by limits", joints=(frozenset(["j0"]),))


# Conflicts: goals that can each be met, and not together.


def conflict_one_site(rng):
    """One site at two places."""
    model = _random_chain(rng, int(rng.integers(3, 7)))
    targets = [pose_of(model, _within(model, rng), "tip")[0] for _ in range(2)]
    if np.linalg.norm(targets[0] - targets[1]) < 1e-3:
        return conflict_one_site(rng)
    goals = [Position("tip", t, name=n) for t, n in zip(targets, "ab", strict=True)]
    return Case("one site", model, goals, "conflict", labels=frozenset("ab"))


def conflict_too_far(rng):
    """Neighbouring points of a chain farther apart than their link is long, each in reach of its own."""
    lengths = rng.uniform(0.3, 1.0, 4)
    model = planar_chain(lengths)
    q1, q2 = rng.uniform(-2.5, 2.5, (2, 4))
    elbow, tip = planar.forward(lengths, q1)[2], planar.forward(lengths, q2)[-1]
    apart, room = np.linalg.norm(elbow - tip), lengths[2] + lengths[3]
    inner = abs(lengths[2] - lengths[3])
    if inner - 1e-3 < apart < room + 1e-3:
        return conflict_too_far(rng)
    goals = [Position("at2", [*elbow, 0], name="elbow"), Position("tip", [*tip, 0], name="tip")]
    return Case("points too far apart", model, goals, "conflict", labels=frozenset(["elbow", "tip"]))


def conflict_heading(rng):
    """A 2R arm to a point with a heading that neither of its two solutions has."""
    lengths = rng.uniform(0.3, 1.2, 2)
    q = np.array([rng.uniform(-3, 3), rng.choice([-1, 1]) * rng.uniform(0.2, 2.9)])
    p = planar.forward(lengths, q)[-1]
    headings = planar.two_links(lengths, p).sum(axis=1)
    heading = rng.uniform(-np.pi, np.pi)
    if np.abs(planar.wrap(headings - heading)).min() < 0.01:
        return conflict_heading(rng)
    goals = [Position("tip", [*p, 0], name="place"), Orientation("tip", quat_z(heading), name="heading")]
    return Case(
        "point and heading", planar_chain(lengths), goals, "conflict", labels=frozenset(["place", "heading"])
    )


def conflict_value(rng):
    """A 2R arm to a point with its elbow asked for another bend than the distance needs."""
    lengths = rng.uniform(0.3, 1.2, 2)
    q = np.array([rng.uniform(-3, 3), rng.choice([-1, 1]) * rng.uniform(0.2, 2.9)])
    bend = rng.uniform(-3, 3)
    if abs(abs(bend) - abs(q[1])) < 0.01:
        return conflict_value(rng)
    goals = [
        Position("tip", [*planar.forward(lengths, q)[-1], 0], name="place"),
        JointValue("j1", bend, name="bend"),
    ]
    return Case(
        "point and bend", planar_chain(lengths), goals, "conflict", labels=frozenset(["place", "bend"])
    )


def conflict_of_two_in_three(rng):
    """Two arms: three goals, of which two on one hand exclude each other and the other hand's is innocent."""
    arm = [([0, 0.2, 0.1], HINGE, unit(rng), (-2, 2)), ([0.3, 0, 0], HINGE, unit(rng), (-2, 2)),
           ([0.25, 0, 0], HINGE, unit(rng), (-2, 2)), ([0.1, 0, 0], BALL, (0, 0, 1), (0, 1.0))]  # fmt: skip
    model = _trunk(arm)
    q1, q2 = _tree_state(model, rng), _tree_state(model, rng)
    left = [pose_of(model, q, "left")[0] for q in (q1, q2)]
    if np.linalg.norm(left[0] - left[1]) < 1e-3:
        return conflict_of_two_in_three(rng)
    goals = [Position("left", left[0], name="a"), Position("right", pose_of(model, q1, "right")[0], name="c"),
             Position("left", left[1], name="b")]  # fmt: skip
    return Case("two of three", model, goals, "conflict", labels=frozenset("ab"))


def conflict_beside_an_innocent_goal(rng):
    """A 2R arm to a point with a wrong heading, which no chain length excludes, beside another arm's goal."""
    case = conflict_heading(rng)
    lengths, other = rng.uniform(0.3, 1.2, 2), rng.uniform(0.3, 1.2, 2)
    q = np.array([rng.uniform(-3, 3), rng.choice([-1, 1]) * rng.uniform(0.2, 2.9)])
    p, heading = planar.forward(lengths, q)[-1], rng.uniform(-np.pi, np.pi)
    if np.abs(planar.wrap(planar.two_links(lengths, p).sum(axis=1) - heading)).min() < 0.01:
        return conflict_beside_an_innocent_goal(rng)

    def links(sizes):
        z = (0, 0, 1)
        ends = [([0, 0, 0], HINGE, z, None), ([sizes[0], 0, 0], HINGE, z, None)]
        return [*ends, ([sizes[1], 0, 0], None, None, None)]

    model = chain(links(lengths), branches=[links(other)])
    free = planar.forward(other, rng.uniform(-3, 3, 2))[-1]
    goals = [Position("tip", [*p, 0], name="place"), Position("tip1", [*free, 0], name="innocent"),
             Orientation("tip", quat_z(heading), name="heading")]  # fmt: skip
    return Case("beside an innocent goal", model, goals, "conflict", labels=case.labels)


def conflict_of_three(rng):
    """A 3R arm to a point with a heading and a first joint's value: any two can be met, all three cannot."""
    lengths = rng.uniform(0.3, 1.0, 3)
    q = np.array(
        [rng.uniform(-1.2, 1.2), rng.choice([-1, 1]) * rng.uniform(0.4, 2.2), rng.uniform(-1.2, 1.2)]
    )
    tip, heading = planar.forward(lengths, q)[-1], q.sum()
    value = q[0] + rng.choice([-1, 1]) * rng.uniform(0.05, 0.6)
    from_elbow = np.linalg.norm(tip - lengths[0] * np.array([np.cos(value), np.sin(value)]))
    room = from_elbow - abs(lengths[1] - lengths[2]), lengths[1] + lengths[2] - from_elbow
    others = planar.three_links_pose(lengths, tip, heading)[:, 0]
    if min(room) < 0.01 or np.abs(planar.wrap(others - value)).min() < 0.02:
        return conflict_of_three(rng)
    goals = [Position("tip", [*tip, 0], name="place"), Orientation("tip", quat_z(heading), name="heading"),
             JointValue("j0", value, name="value")]  # fmt: skip
    labels = frozenset(["place", "heading", "value"])
    return Case("three at once", planar_chain(lengths), goals, "conflict", labels=labels)


REACHABLE = (reachable_pose, reachable_point, reachable_at_limit, reachable_stretched, reachable_wrist,
             reachable_several)  # fmt: skip
BEYOND = (beyond_ring, beyond_plane, beyond_sphere, beyond_tilt, beyond_surface, beyond_heading, beyond_wrist)
LIMITED = (
    limited_two_links,
    limited_three_links,
    limited_elbow,
    limited_point,
    limited_value,
    limited_direction,
    beyond_slides,
)
CONFLICT = (
    conflict_one_site,
    conflict_too_far,
    conflict_heading,
    conflict_value,
    conflict_of_two_in_three,
    conflict_beside_an_innocent_goal,
    conflict_of_three,
)


def mistakes(case, solution, *, tolerance=1e-5):
    """What is wrong with a solution of a case, in words; empty when right."""
    verdict = solution.verdict
    wrong = []
    if verdict.kind != case.kind:
        wrong.append(f"{verdict.kind} instead of {case.kind}")
        return wrong
    if case.distance is not None and abs(verdict.position - case.distance) > tolerance:
        wrong.append(f"distance {verdict.position} instead of {case.distance}")
    if case.rotation is not None and abs(verdict.rotation - case.rotation) > tolerance:
        wrong.append(f"rotation {verdict.rotation} instead of {case.rotation}")
    if case.joints and not any(frozenset(verdict.joints or ()) == named for named in case.joints):
        wrong.append(f"joints {verdict.joints} instead of one of {case.joints}")
    if case.labels and frozenset(verdict.goals) != case.labels:
        wrong.append(f"goals {verdict.goals} instead of {case.labels}")
    return wrong + illegal(case.model, solution.q)


def illegal(model, q):
    """Joints of q that are not finite or outside their limits, in words."""
    wrong = [] if np.isfinite(q).all() else ["not finite"]
    for j in np.flatnonzero(model.jnt_limited):
        x = q[model.jnt_qposadr[j] :]
        if model.jnt_type[j] == BALL:
            angle = 2 * np.arctan2(np.linalg.norm(x[1:4]), abs(x[0]))
            outside = angle - model.jnt_range[j, 1]
        else:
            outside = max(model.jnt_range[j, 0] - x[0], x[0] - model.jnt_range[j, 1])
        if outside > 1e-12:
            wrong.append(f"joint {j} outside by {outside}")
    return wrong
