"""The nearest possible motion: spacetime constraints by direct collocation under the machine's full dynamics.

(A. Witkin, M. Kass, Spacetime constraints, SIGGRAPH 1988), with exact derivatives of the compiled model's own
program, solved by IPOPT on grids that are refined where the result does not yet hold between their points.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....models import dof_names, name_of
from ....sim.clip import Clip
from ....sim.errors import PantographError
from ....sim.kinds import SCALAR
from ..contact import Phase
from ..ends import AtRest, astray_text, resting
from ..fitted import Certificate, Fitted
from ..machine import Machine
from ..watch import interruptible, watch
from .certify import examine
from .kept import kept
from .mesh import grid, refined
from .transcription import Point, Transcription, Wish

Array = NDArray[np.float64]
Progress = Callable[[str], None]
_CLOSE = 5.0  # tolerances missed with which friction is made sharper
_EFFORT = 1e-3
_REACHED = 1e-5  # what constraints may be missed by


def fit(
    clip: Clip,
    machine: Machine,
    *,
    hard: Sequence[float] = (),
    phases: Sequence[Phase] = (),
    effort: float | None = None,
    deviation: float = 1.0,
    step: float = 0.04,
    at_rest: AtRest = None,
    tolerance: float = 1e-3,
    refine: int = 4,
    most: int = 500,
    progress: Progress | None = None,
) -> Fitted:
    """The motion nearest to ``clip`` that ``machine`` can make, through its poses at the ``hard`` times [s].

    Minimises the integral of ``deviation`` |q - keys|^2 plus ``effort`` |tau / strength|^2 + jerkiness over
    all keyed joints. Without a given ``effort`` (then 1e-3), keys that are possible stay as they are, where
    there are no ``phases``. Joints without keys move as physics and the fit want, but things that nothing
    keys, drives or touches are left out. ``phases`` declare contacts, into which sites come without impact.
    It begins in the first pose, and begins and ends ``at_rest``, or (False) at the keyed velocity; by default
    at rest where the keys are (:func:`~..ends.resting`), else as fast as keyed or slower. What is thrown,
    with keys and without a drive, does so at any speed; what has neither is free at the end. ``step`` [s] is
    the longest piece of the first grid, ``most`` the most iterations on one.

    Dry friction is smoothed at low speed, where nothing drives below the machine's ``width``, and wider ones
    at first; a drive has to be able to overcome all of it where a joint is as slow, also where it could help
    to hold.

    Up to ``refine`` times, the pieces on which the motion does not hold to ``tolerance`` (limits, and forces
    missing relative to the largest) are cut, and limits are drawn in by what it exceeds them between points;
    the certificate says whether it holds in the end. ``progress`` is told in words what is at work.

    Raises PantographError for poses that no motion reaches in time, keys outside of the clip, sites that do
    not exist or are not on the ground where the pose is given, and when no motion fits, saying what is left
    over.
    """
    for t in hard:
        if not clip.start <= t <= clip.end:
            raise PantographError(
                f"a hard key at {t:g} s lies outside of the clip, {clip.start:g} to {clip.end:g} s"
            )
    if not clip.end > clip.start:
        raise PantographError("there is nothing to fit: no joint has two keys")
    ends = resting(clip, at_rest)
    weight = _EFFORT if effort is None else effort
    wish = Wish(
        clip, tuple(hard), tuple(phases), weight, deviation, ends, slower=not isinstance(at_rest, bool)
    )
    if text := _hopeless(wish, machine):
        raise PantographError(f"no motion fits: {text}")
    nodes, margin, found, before = grid(clip, hard, phases, step), 1.0, None, None
    if effort is None and not phases and (same := kept(clip, machine, nodes, ends, tolerance)):
        return same
    widths = _widths(machine)
    rounds = refine + len(widths)
    able = replace(machine, width=widths.pop(0))
    for round_ in range(rounds):
        missed = "" if found is None else f", missed {found.certificate.by_piece.max():.3g} tolerances"
        words = f"grid {round_ + 1} of {rounds} at most, {len(nodes) - 1} pieces{missed}"
        each = None if progress is None else partial(_tell, progress, words)
        problem = Transcription(wish, _drawn_in(able, margin), nodes)
        found, before = _solve(problem, able, tolerance, most, before, each)
        certificate = found.certificate
        if certificate.holds and not widths:
            break
        if certificate.limits > 1.0 + tolerance and (round_ > 0 or certificate.limits < 1.02):
            margin = max(0.9, margin / certificate.limits)
        if widths and certificate.by_piece.max() <= _CLOSE:
            able = replace(machine, width=widths.pop(0))
        nodes = refined(nodes, certificate.by_piece, found.clip, able, tolerance * certificate.largest)
    assert found is not None
    return found


def _widths(machine: Machine) -> list[float]:
    """Speeds below which friction is smoothed, round by round.

    Where nothing drives, a turn of friction is as short as it is sharp, and shifts until grids resolve it.
    """
    passive = (machine.friction > 0) & ~machine.driven
    return [k * machine.width for k in ((8.0, 4.0, 2.0, 1.0) if passive.any() else (1.0,))]


def _hopeless(wish: Wish, machine: Machine) -> str | None:
    """What makes the given poses impossible whatever the motion between them is, in words, or None."""
    if text := astray_text(machine, wish.clip, wish.phases):
        return text
    clip, model = wish.clip, machine.model
    t = np.unique([clip.start, *wish.hard])
    q, names = clip.evaluate(t, left=True).q, dof_names(model)
    scalar = np.isin(model.jnt_type[model.dof_jntid], SCALAR)
    column = model.jnt_qposadr[model.dof_jntid]
    for dof in np.flatnonzero(scalar & clip.dofs):
        at, low, high = q[:, column[dof]], machine.low[dof], machine.high[dof]
        beyond = np.maximum(low - at, at - high)
        if beyond.max() > 1e-9:
            k = int(beyond.argmax())
            return f"the pose at {t[k]:g} s is {beyond[k]:.4g} rad or m beyond the range of {names[dof]!r}"
        speed = np.abs(np.diff(at)) / np.maximum(np.diff(t), 1e-300)
        if len(speed) and speed.max() > machine.velocity[dof]:
            k = int(speed.argmax())
            return (
                f"from the pose at {t[k]:g} s to that at {t[k + 1]:g} s {names[dof]!r} moves at "
                f"{speed[k]:.4g} rad/s or m/s in the mean, its limit is {machine.velocity[dof]:.4g}"
            )
    return None if wish.slower else _too_fast(wish, machine)


def _too_fast(wish: Wish, machine: Machine) -> str | None:
    """An end that is to have the keyed speed, beyond its limit."""
    clip, given = wish.clip, machine.driven & wish.clip.dofs
    for t, rests in zip((clip.start, clip.end), wish.at_rest, strict=True):
        v = np.abs(clip.evaluate(t, left=t == clip.end).v)
        over = np.where(given, v - machine.velocity, -np.inf)
        if not rests and over.max() > 0:
            dof = int(over.argmax())
            return (
                f"at_rest = false begins and ends as fast as keyed: {dof_names(machine.model)[dof]!r} moves "
                f"at {v[dof]:.4g} rad/s or m/s at {t:g} s, its limit is {machine.velocity[dof]:.4g}"
            )
    return None


def _too_weak(wish: Wish, machine: Machine) -> str:
    """A rest that the drives cannot hold, in words, or nothing: it may be passed, but hardly kept."""
    ends = [t for t in (wish.clip.start, wish.clip.end) if t == wish.clip.start or t in wish.hard]
    for t in ends:
        if not wish.at_rest[t > wish.clip.start]:
            continue
        if any(p.holds(np.array([t]))[0] for p in wish.phases):
            continue
        weight = machine.nominal.weight(wish.clip.evaluate(t, left=True).q)
        weight += np.where(weight < 0, -1.0, 1.0) * machine.friction
        over = np.maximum(weight - machine.force_high, machine.force_low - weight)
        dof = np.where(machine.driven, over, -np.inf).argmax()
        if machine.driven[dof] and over[dof] > 0:
            limit = machine.force_high[dof] if weight[dof] > 0 else -machine.force_low[dof]
            return (
                f"; at rest at {t:g} s {dof_names(machine.model)[dof]!r} needs {abs(weight[dof]):.4g} N m "
                f"or N to hold the pose{' and overcome its friction' if machine.friction[dof] else ''}, its "
                f"limit is {limit:.4g}"
            )
    return ""


def _tell(progress: Progress, words: str, iteration: int) -> None:
    progress(f"{words}, iteration {iteration}")


def _drawn_in(machine: Machine, margin: float) -> Machine:
    """``machine`` with less of everything, so that what lies between grid points stays within its own."""
    names = ("velocity", "acceleration", "jerk", "force_low", "force_high", "top_speed")
    return replace(
        machine, **{n: margin * getattr(machine, n) for n in names}, current=margin * machine.current
    )


def _solve(
    problem: Transcription,
    true: Machine,
    tolerance: float,
    most: int,
    before: tuple[Array, Point] | None,
    each: Callable[[int], None] | None,
) -> tuple[Fitted, tuple[Array, Point]]:
    """Solve from the keys or from what was found ``before``, and certify against the ``true`` machine."""
    import casadi as ca

    if text := problem.off_ground():
        raise PantographError(text)
    program = problem.program()
    low, high = problem.bounds()
    count = int(program.g.numel())
    lower = np.concatenate([np.zeros(program.equal), np.full(count - program.equal, -np.inf)])
    begun = time.perf_counter()
    guard = watch(int(program.x.numel()), count, each)
    rest = np.inf
    for warm in (True, False) if before is not None else (False,):
        options = _options(most, warm) | {"iteration_callback": guard}
        solver = ca.nlpsol("fit", "ipopt", {"x": program.x, "f": program.cost, "g": program.g}, options)
        start = _between(problem, *before) if warm and before is not None else problem.guess()
        with interruptible(guard):
            done = solver(x0=problem.pack(start), lbx=low, ubx=high, lbg=lower, ubg=np.zeros(count))
        left = np.asarray(done["g"]).ravel()
        over = left[program.equal :].max(initial=0.0)
        rest = float(max(np.abs(left[: program.equal]).max(initial=0.0), over))
        if rest <= _REACHED:
            break
    seconds, stats = time.perf_counter() - begun, solver.stats()
    words = str(stats["return_status"]).replace("_", " ").lower()
    if not rest <= _REACHED:
        raise PantographError(
            f"no motion was found that fits: constraints are missed by {rest:.2g} after "
            f"{stats['iter_count']} iterations ({words}); loosen hard keys, give more time, or a "
            f"stronger machine{_too_weak(problem.wish, true)}"
        )
    point, off = problem.unpack(np.asarray(done["x"]).ravel())
    wish, t = problem.wish, problem.t
    clip = _clip(problem, t, point)
    finding = examine(true, clip, t, point.force, problem.sites, wish.phases)
    slip = finding.contact / max(float(problem.model.stat.extent), 1e-9)
    by_piece = np.maximum(np.maximum(finding.limits - 1.0, 0.0), finding.dynamics) / tolerance
    certificate = Certificate(
        limits=float(finding.limits.max(initial=0.0)),
        dynamics=float(finding.dynamics.max(initial=0.0)),
        largest=finding.largest,
        contact=finding.contact,
        tolerance=tolerance,
        holds=bool(max(by_piece.max(initial=0.0), slip / tolerance) <= 1.0),
        solver=rest,
        status=words,
        iterations=int(stats["iter_count"]),
        seconds=seconds,
        pieces=len(t) - 1,
        by_piece=by_piece,
    )
    full = np.zeros((len(t), problem.model.nv))
    full[:, problem.driven] = point.tau
    contact = np.vstack([point.force[0], point.force[2, -1:]])
    worst = float(np.abs(off[:, wish.clip.dofs]).max(initial=0.0))
    fitted = Fitted(clip, t, full, contact, point.force[1], problem.sites, wish.phases, worst, certificate)
    return fitted, (t, point)


def _options(most: int, warm: bool) -> dict[str, Any]:
    ipopt: dict[str, Any] = {
        "print_level": 0,
        "sb": "yes",
        "max_iter": most,
        "tol": 1e-8,
        "constr_viol_tol": 1e-10,
        # where the cost has stopped falling, motion has stopped changing
        "acceptable_tol": 1e-3,
        "acceptable_constr_viol_tol": 1e-9,
        "acceptable_obj_change_tol": 1e-4,
        "acceptable_iter": 5,
    }
    if warm:
        ipopt |= {"mu_init": 1e-7, "bound_push": 1e-6, "bound_frac": 1e-6, "acceptable_tol": 1e-5}
    return {"print_time": False, "error_on_fail": False, "ipopt": ipopt}


def _clip(problem: Transcription, t: Array, point: Point) -> Clip:
    like = problem.wish.clip
    whole = problem.charts.clip(t, point.q[::2], point.v[::2], point.a[0], point.a[2], like)
    joints = np.unique(like.model.dof_jntid[problem.inside])
    names = [name_of(like.model, "joint", int(j)) for j in joints]
    return Clip(like.model, {name: whole.tracks[name] for name in names}, like.q0)


def _between(problem: Transcription, t: Array, point: Point) -> Point:
    """A point over nodes ``t`` as one over the nodes of ``problem``."""
    q, v, a = _clip(problem, t, point).evaluate(problem.times)
    tau = np.stack([np.interp(problem.t, t, column) for column in point.tau.T], axis=1)
    at = problem.times[problem.states]
    piece = np.clip(np.searchsorted(t, at[1], side="right") - 1, 0, len(t) - 2)
    s = np.clip((at - t[piece]) / np.diff(t)[piece], 0.0, 1.0)[:, :, None]
    f0, fm, f1 = (f[piece] for f in point.force)
    force = (1 - s) * (1 - 2 * s) * f0 + 4 * s * (1 - s) * fm + s * (2 * s - 1) * f1
    return Point(q, v, tau, a[problem.states], force)
