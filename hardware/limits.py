"""Can the rig make this motion? A verdict before anything moves, and how much slower it could.

A motion slowed k times has, with x = 1/k, the speeds v x, the accelerations a x^2 and the forces
static + viscous x + dynamic x^2; the motor gives at most stall (1 - speed / free speed). Every limit is a
polynomial in x of degree two at most, and its first positive root is the fastest x up to which every slower
motion fits as well: the slowdown is computed, in closed form, not searched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .mapping import Bounds, JointBounds, Mapping
from .motion import Loads, Motion
from .rig import RigError

Array = NDArray[np.float64]
Kind = Literal["position", "speed", "acceleration", "torque"]
_SLACK = 1e-9  # relative: a motion that was slowed to a limit keeps it
_ROUNDING = 2 * np.pi / 4096  # rad: a position within one count of its limit is at it


class MotionRefused(RigError):
    """The rig cannot make a motion; carries the verdict."""

    def __init__(self, verdict: Verdict, hint: str) -> None:
        super().__init__(f"{verdict}\n{hint}")
        self.verdict = verdict


@dataclass(frozen=True)
class Check:
    """The worst of one kind for one joint or servo.

    peak and limit in `unit`; share: part of the limit that is used (for positions, of the way from the middle
    of the range to its end); at: when [s]; who: the joint or servo; slowdown: factor that makes it fit (1: it
    fits; infinite: none does).
    """

    kind: Kind
    who: str
    peak: float
    limit: float
    unit: str
    share: float
    at: float
    slowdown: float

    @property
    def ok(self) -> bool:
        """Whether the limit is kept."""
        return self.slowdown <= 1.0

    def __str__(self) -> str:
        fix = ""
        if not self.ok:
            fix = (
                f" -> {self.slowdown:.3g} times slower would do"
                if np.isfinite(self.slowdown)
                else " -> no slowing helps"
            )
        size = f"{self.peak:.4g} {self.unit}".strip()
        return f"{self.kind} of {self.who}: {size} of {self.limit:.4g} at t = {self.at:.3f} s{fix}"


@dataclass(frozen=True)
class JointVerdict:
    """Verdict for one joint: its worst check of each kind."""

    joint: str
    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        """Whether all limits are kept."""
        return all(c.ok for c in self.checks)


@dataclass(frozen=True)
class Verdict:
    """Verdict for a motion, joint by joint; notes say what was left out."""

    joints: tuple[JointVerdict, ...]
    notes: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether the rig can make the motion as it is."""
        return all(j.ok for j in self.joints)

    @property
    def slowdown(self) -> float:
        """Factor by which the motion fits (1: as it is; infinite: never)."""
        return max((c.slowdown for j in self.joints for c in j.checks), default=1.0)

    def __str__(self) -> str:
        lines = []
        for j in self.joints:
            worst = max(j.checks, key=lambda c: (c.slowdown, c.share))
            if j.ok:
                lines.append(f"  {j.joint}: fits; nearest is the {worst}")
            lines += [f"  {j.joint}: {c}" for c in j.checks if not c.ok]
        head = "the rig can make this motion" if self.ok else "the rig cannot make this motion"
        return "\n".join([head, *lines, *(f"  note: {n}" for n in self.notes)])


def check_motion(
    motion: Motion, mapping: Mapping, servos: Bounds, joints: JointBounds, loads: Loads | None = None
) -> Verdict:
    """Hold a motion against every limit of joints and servos; torque is left out without `loads`."""
    t = motion.dense()
    q, v = motion.at(t)
    if (beyond := mapping.beyond(q)).any():
        return _out_of_reach(mapping, t, q, beyond, joints)
    s = mapping.servo(q)
    servo_v, _ = mapping.rates(q, v, np.zeros_like(v))
    servo_v_knots, servo_a = mapping.rates(motion.q, motion.v, motion.a)
    owners = [np.flatnonzero(mapping.matrix[:, j]) for j in range(len(mapping.joints))]
    units = mapping.units
    turns = ["rad"] * len(mapping.servos)
    tables = [
        _position(mapping.joints, t, q, joints.low, joints.high, "joint", units),
        _power("speed", mapping.joints, t, v, joints.velocity, units, "/s", 1, "joint"),
        _power(
            "acceleration", mapping.joints, motion.t, motion.a, joints.acceleration, units, "/s^2", 2, "joint"
        ),
    ]
    servo_tables = [
        _position(mapping.servos, t, s, servos.low, servos.high, "servo", turns),
        _power("speed", mapping.servos, t, servo_v, servos.velocity, turns, "/s", 1, "servo"),
        _power(
            "acceleration", mapping.servos, motion.t, servo_a, servos.acceleration, turns, "/s^2", 2, "servo"
        ),
    ]
    notes: tuple[str, ...] = ()
    if loads is None:
        notes = ("torque was not checked: the motion comes without a model's forces",)
    else:
        tables.append(_force(mapping, motion.t, loads, joints.torque))
        servo_tables.append(_torque(mapping, motion, loads, servo_v_knots, servos))
    verdicts = []
    for j, name in enumerate(mapping.joints):
        kinds: dict[Kind, list[Check]] = {}
        found = [table[j] for table in tables] + [table[i] for table in servo_tables for i in owners[j]]
        for check in found:
            kinds.setdefault(check.kind, []).append(check)
        worst = tuple(max(list_, key=lambda c: (c.slowdown, c.share)) for list_ in kinds.values())
        verdicts.append(JointVerdict(name, worst))
    return Verdict(tuple(verdicts), notes)


def _out_of_reach(
    mapping: Mapping, t: Array, q: Array, beyond: NDArray[np.bool_], joints: JointBounds
) -> Verdict:
    """Of a motion that takes joints where their transmissions do not reach: servos have no angles there."""
    verdicts = []
    for j in np.flatnonzero(beyond.any(axis=0)):
        k, name = int(np.argmax(beyond[:, j])), mapping.joints[j]
        value, ends = q[k, j], (joints.low[j], joints.high[j])
        limit = min(ends, key=lambda end: abs(end - value))
        where = (value, limit, mapping.units[j], np.inf, float(t[k]), np.inf)
        verdicts.append(JointVerdict(name, (Check("position", f"joint {name}", *where),)))
    return Verdict(tuple(verdicts), ("nothing else was judged: a transmission does not reach there",))


def fit(motion: Motion, verdict: Verdict, *, slow: bool) -> Motion:
    """The motion as it is when it fits, slowed to fit when asked; else MotionRefused with the verdict."""
    if verdict.ok:
        return motion
    factor = verdict.slowdown
    if not np.isfinite(factor):
        raise MotionRefused(
            verdict, "slowing down does not help; change the motion, or the limits of the rig"
        )
    if not slow:
        raise MotionRefused(
            verdict, f"slowed {factor:.3g} times it fits: ask for that with --slow (slow=True)"
        )
    return motion.slow(factor)


def _position(
    names: tuple[str, ...], t: Array, q: Array, low: Array, high: Array, who: str, units: Sequence[str]
) -> list[Check]:
    out = []
    for i, name in enumerate(names):
        beyond = np.maximum(q[:, i] - high[i], low[i] - q[:, i])
        k = int(np.argmax(beyond))
        half = (high[i] - low[i]) / 2
        slack = _ROUNDING if who == "servo" else 1e-3 * half if np.isfinite(half) else 0.0
        share = 1 + float(beyond[k]) / half if np.isfinite(half) else 0.0
        limit = high[i] if q[k, i] - high[i] >= low[i] - q[k, i] else low[i]
        slower = np.inf if beyond[k] > slack else 1.0
        out.append(Check("position", f"{who} {name}", q[k, i], limit, units[i], share, float(t[k]), slower))
    return out


def _power(
    kind: Kind,
    names: tuple[str, ...],
    t: Array,
    value: Array,
    limit: Array,
    units: Sequence[str],
    per: str,
    power: int,
    who: str,
) -> list[Check]:
    """Limits on |value| that scale as x^power."""
    out = []
    for i, name in enumerate(names):
        size = np.where(np.isfinite(value[:, i]), np.abs(value[:, i]), np.inf)
        k = int(np.argmax(size))
        share = float(size[k] / limit[i])
        slower = 1.0 if share <= 1 + _SLACK else share ** (1 / power)
        unit = units[i] + per
        out.append(Check(kind, f"{who} {name}", float(size[k]), limit[i], unit, share, float(t[k]), slower))
    return out


def _force(mapping: Mapping, t: Array, loads: Loads, limit: Array) -> list[Check]:
    """Force limits of joints."""
    out = []
    for j, name in enumerate(mapping.joints):
        parts = loads.static[:, j], loads.viscous[:, j], loads.dynamic[:, j]
        out.append(_worst_force(f"joint {name}", t, *parts, limit[j], np.zeros_like(t), np.inf))
    return out


def _torque(mapping: Mapping, motion: Motion, loads: Loads, servo_v: Array, servos: Bounds) -> list[Check]:
    """Torque limits of servos, and the line of the motor."""
    static, viscous, dynamic = (
        mapping.torque(motion.q, part) for part in (loads.static, loads.viscous, loads.dynamic)
    )
    out = []
    for i, name in enumerate(mapping.servos):
        parts = static[:, i], viscous[:, i], dynamic[:, i]
        own = _worst_force(
            f"servo {name}", motion.t, *parts, servos.torque[i], np.zeros_like(motion.t), np.inf
        )
        line = _worst_force(
            f"servo {name}", motion.t, *parts, servos.stall[i], servo_v[:, i], servos.free_speed[i]
        )
        out.append(max((own, line), key=lambda c: (c.slowdown, c.share)))
    return out


def _worst_force(
    who: str, t: Array, f0: Array, f1: Array, f2: Array, limit: float, v: Array, free_speed: float
) -> Check:
    """Where |f0 + f1 x + f2 x^2| <= limit (1 - |v| x / free_speed) comes nearest to breaking, or breaks."""
    force = f0 + f1 + f2
    if not np.isfinite(limit):
        k = int(np.argmax(np.abs(force)))
        return Check("torque", who, abs(float(force[k])), limit, "N m", 0.0, float(t[k]), 1.0)
    loss = np.abs(v) / free_speed
    available = np.maximum(limit * (1 - loss), 1e-12)
    share = np.abs(force) / available
    k = int(np.argmax(share))
    slower = 1.0
    if share[k] > 1 + _SLACK:
        x, k = _first_root(f0, f1, f2, limit, loss)
        slower = 1 / x if x > 0 else np.inf
    return Check(
        "torque",
        who,
        abs(float(force[k])),
        limit * max(0.0, 1 - loss[k]),
        "N m",
        float(share[k]),
        float(t[k]),
        slower,
    )


def _first_root(f0: Array, f1: Array, f2: Array, limit: float, loss: Array) -> tuple[float, int]:
    """Largest x such that the force limit holds at every sample and every speed up to x; and the sample."""
    best, where = np.inf, 0
    for sign in (1.0, -1.0):
        c0, c1, c2 = sign * f0 - limit, sign * f1 + limit * loss, sign * f2
        discriminant = c1 * c1 - 4 * c2 * c0
        with np.errstate(invalid="ignore", divide="ignore"):
            bottom = c1 + np.sqrt(discriminant)
            root = np.where((discriminant >= 0) & (bottom > 0), -2 * c0 / bottom, np.inf)
        root = np.where(c0 >= 0, 0.0, root)
        k = int(np.argmin(root))
        if root[k] < best:
            best, where = float(root[k]), k
    return best * (1 - _SLACK), where
