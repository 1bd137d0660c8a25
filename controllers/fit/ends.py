"""What a motion asks for before any limit does: where it starts, whether it jumps, and rest at its ends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...models import dof_names
from ...sim.clip import Clip
from ...sim.kinds import SCALAR, SLIDE
from ..nominal import difference
from .contact import Phase, carried
from .machine import Machine

Array = NDArray[np.float64]
AtRest = bool | tuple[bool, bool] | None
"""Whether a motion begins and ends at rest; None: see :func:`resting`."""
_STILL = 1e-9  # of the largest speed
_CORNER = 1e-6  # of the largest speed


class Jump(NamedTuple):
    """A freedom whose place or speed would change at once, by ``size`` [rad, m, or per s] at ``t`` [s]."""

    dof: int
    t: float
    size: float
    of_speed: bool


def resting(clip: Clip, at_rest: AtRest = None, duration: float | None = None) -> tuple[bool, bool]:
    """Whether a motion has to begin and to end at rest, ``at_rest`` as given, else where its keys do.

    What is held before the first key, from time zero on, or after the last one, to the end of a scene's
    ``duration`` [s], rests there whatever speed the keys have.
    """
    if at_rest is not None:
        return at_rest if isinstance(at_rest, tuple) else (at_rest, at_rest)
    first, last = clip.evaluate(clip.start), clip.evaluate(clip.end, left=True)
    still = _STILL * max(_fastest(clip), 1e-300)
    before = clip.start > 0.0 and not clip.evaluate(clip.start, left=True).v.any()
    longer = duration is not None and duration > clip.end * (1.0 + 1e-9)
    after = longer and not clip.evaluate(clip.end).v.any()
    return (
        bool(before or np.abs(first.v).max(initial=0.0) <= still),
        bool(after or np.abs(last.v).max(initial=0.0) <= still),
    )


def jumps(clip: Clip, ends: tuple[bool, bool]) -> list[Jump]:
    """The largest jump of each keyed freedom's place and speed, ends ``at rest`` among them."""
    t = clip.breaks_between(clip.start, clip.end)
    t = t[(t > clip.start) & (t < clip.end)]
    before, after = clip.evaluate(t, left=True), clip.evaluate(t)
    places = np.array([difference(clip.model, *row) for row in zip(before.q, after.q, strict=True)])
    speeds = after.v - before.v
    for rests, at in zip(ends, (clip.start, clip.end), strict=True):
        if rests:
            t = np.append(t, at)
            speeds = np.vstack([speeds, clip.evaluate(at, left=at == clip.end).v])
    places = np.vstack([places.reshape(-1, clip.model.nv), np.zeros((len(t) - len(places), clip.model.nv))])
    out = []
    for sizes, least, of_speed in (
        (np.abs(places), 1e-9, False),
        (np.abs(speeds), _CORNER * _fastest(clip), True),
    ):
        for dof in np.flatnonzero((sizes > least).any(axis=0)):
            k = int(sizes[:, dof].argmax())
            out.append(Jump(int(dof), float(t[k]), float(sizes[k, dof]), of_speed))
    return out


def moving(machine: Machine, clip: Clip, phases: Sequence[Phase]) -> NDArray[np.bool_]:
    """Freedoms (nv,) that a motion is about: not those of things that nothing keys, drives, or touches in a
    phase, which stay as they are."""
    tree = machine.model.dof_treeid
    mine = tree[machine.driven | clip.dofs | carried(machine.model, phases)]
    return np.asarray(np.isin(tree, mine))


def astray(machine: Machine, clip: Clip, phases: Sequence[Phase] = ()) -> Array:
    """How far (nv,) [rad, m] joints without keys start outside of their ranges."""
    model, out = machine.model, np.zeros(machine.model.nv)
    scalar = np.isin(model.jnt_type[model.dof_jntid], SCALAR)
    for dof in np.flatnonzero(scalar & moving(machine, clip, phases) & ~clip.dofs):
        q = clip.q0[model.jnt_qposadr[model.dof_jntid[dof]]]
        out[dof] = max(machine.low[dof] - q, q - machine.high[dof], 0.0)
    return np.where(out > 1e-9, out, 0.0)


def astray_text(machine: Machine, clip: Clip, phases: Sequence[Phase] = ()) -> str:
    """What to do about joints without keys that start outside of their ranges; nothing where none does."""
    model, names, rows = machine.model, dof_names(machine.model), []
    for dof in np.flatnonzero(astray(machine, clip, phases)):
        joint = model.dof_jntid[dof]
        unit = "m" if model.jnt_type[joint] == SLIDE else "rad"
        q = clip.q0[model.jnt_qposadr[joint]]
        rows.append(
            f"{names[dof]!r} (at {q:.4g}, range {machine.low[dof]:.4g} to {machine.high[dof]:.4g} {unit})"
        )
    if not rows:
        return ""
    one = len(rows) == 1
    return (
        f"{'joint' if one else 'joints'} without keys {'starts' if one else 'start'} out of range: "
        f"{', '.join(rows)}; give {'it' if one else 'them'} a place within by [initial.position], or keys"
    )


def _fastest(clip: Clip) -> float:
    t = np.linspace(clip.start, clip.end, 401)
    return float(np.abs(clip.evaluate(t, left=True).v).max(initial=0.0))
