"""Pictures of a loop: Bode plot with margins, root locus, step response. They return matplotlib figures."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from .analysis import closed_loop, growth, loop_response, margins, root_locus, step_info, step_response
from .linear import LinearSystem

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
_SAMPLES = 600  # of a step response, about


def bode(system: LinearSystem, K: ArrayLike, *, input: int = 0) -> Figure:
    """Loop gain [dB] and phase [deg] over frequency [rad/s], cut at one ``input``, its margins marked."""
    from matplotlib.figure import Figure

    found = margins(system, K, input=input)
    middle = found.crossover if np.isfinite(found.crossover) else 1.0
    high = 1e2 * middle if system.period is None else np.pi / system.period
    w = np.geomspace(1e-3 * middle, high, 800)
    L = loop_response(system, K, w, input=input)
    chart = Figure(figsize=(8, 6), layout="constrained")
    top, bottom = chart.subplots(2, 1, sharex=True)
    top.semilogx(w, 20.0 * np.log10(np.abs(L), out=np.full(len(w), np.nan), where=L != 0.0))
    phase = np.degrees(np.unwrap(np.angle(L)))
    if found.stable and np.isfinite(
        found.phase
    ):  # of the turns that an angle leaves open, those that show the margin
        phase -= 360.0 * np.round((np.interp(middle, w, phase) + 180.0 - np.degrees(found.phase)) / 360.0)
        bottom.vlines(found.crossover, -180.0, -180.0 + np.degrees(found.phase), color="C1", lw=3)
    bottom.semilogx(w, phase)
    bottom.axhline(-180.0, color="grey", lw=0.8)
    for ax in (top, bottom):
        ax.axvline(found.crossover, color="grey", ls=":")
        ax.grid(alpha=0.3, which="both")
    top.axhline(0.0, color="grey", lw=0.8)
    top.set_ylabel("loop gain [dB]")
    bottom.set_ylabel("phase [deg]")
    bottom.set_xlabel("frequency [rad/s]")
    low, up = found.gain
    if not found.stable:
        chart.suptitle(f"{system.inputs[input]}: the closed loop is unstable")
        return chart
    chart.suptitle(
        f"{system.inputs[input]}: phase margin {np.degrees(found.phase):.1f} deg, delay {found.delay:.3g} s, "
        f"gain from {low:.2g} to {up:.3g}, disk {found.disk:.2f}"
    )
    return chart


def locus(system: LinearSystem, K: ArrayLike, *, most: float = 3.0) -> Figure:
    """Closed-loop poles under u = -factor K x for factors from 0 (crosses) over 1 (dots) to ``most``."""
    from matplotlib.figure import Figure

    poles = root_locus(system, K, np.concatenate([np.linspace(0.0, 1.0, 200), np.linspace(1.0, most, 200)]))
    chart = Figure(figsize=(6, 6), layout="constrained")
    ax = chart.subplots()
    for branch in poles.T:
        ax.plot(branch.real, branch.imag, lw=1.2)
    ax.plot(poles[0].real, poles[0].imag, "kx", label="open loop")
    ax.plot(poles[199].real, poles[199].imag, "ko", ms=5, label="closed loop")
    if system.period is None:
        ax.axvline(0.0, color="grey", lw=0.8)
    else:
        turn = np.exp(2j * np.pi * np.linspace(0, 1, 200))
        ax.plot(turn.real, turn.imag, color="grey", lw=0.8)
        near = np.concatenate([poles[0], poles[199], [-1.05, 1.05]])  # branches may leave for far away
        ax.set_xlim(near.real.min() - 0.1, near.real.max() + 0.1)
        ax.set_ylim(-max(1.1, 1.1 * np.abs(near.imag).max()), max(1.1, 1.1 * np.abs(near.imag).max()))
        ax.set_aspect("equal")
    ax.set_xlabel("real part [1/s]" if system.period is None else "real part")
    ax.set_ylabel("imaginary part [rad/s]" if system.period is None else "imaginary part")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    return chart


def step(system: LinearSystem, K: ArrayLike, output: int, *, input: int = 0) -> Figure:
    """Response of a state to a unit step of force on one ``input`` of the closed loop, with its figures."""
    from matplotlib.figure import Figure

    loop = closed_loop(system, K)
    poles = linalg.eigvals(loop.A)
    grows = growth(poles, system.period)
    row = np.zeros(len(loop.A))
    row[output] = 1.0
    span = min(1.0, 8.0 / grows) if grows else 6.0 / _slowest(loop, row, input)
    t, sampled = _grid(loop, span)
    y = step_response(sampled, row, t, input=input)
    info = step_info(t, y)
    chart = Figure(figsize=(8, 4), layout="constrained")
    ax = chart.subplots()
    ax.plot(t, y)
    if not grows:
        ax.axhspan(0.98 * info.final, 1.02 * info.final, color="grey", alpha=0.2)
    ax.set_xlabel("time [s]")
    ax.set_ylabel(f"{system.states[output]} for 1 N or N m")
    figures = f"rise {info.rise:.3g} s, settling {info.settling:.3g} s, overshoot {info.overshoot:.1%}"
    ax.set_title("unstable" if grows else figures, fontsize=10)
    ax.grid(alpha=0.3)
    return chart


def _slowest(loop: LinearSystem, row: Array, input: int) -> float:
    """Rate [1/s] at which the slowest part of the response dies out that is a thousandth of the largest."""
    poles, left, right = linalg.eig(loop.A, left=True, right=True)
    rates = -poles.real if loop.period is None else -np.log(np.abs(poles) + 1e-300) / loop.period
    share = np.abs((row @ right) * (left.conj().T @ loop.B[:, input]))
    share /= np.abs(np.sum(left.conj() * right, axis=0)) + 1e-300
    share /= np.abs(poles if loop.period is None else 1.0 - poles) + 1e-12
    return max(float(rates[share > 1e-3 * share.max()].min()), 1e-4)  # hours are no matter of a picture


def _grid(loop: LinearSystem, span: float) -> tuple[Array, LinearSystem]:
    """Times up to ``span`` [s] or a few periods, and the loop from each to the next with inputs held."""
    if loop.period is None:
        return np.linspace(0.0, span, _SAMPLES), loop
    ticks = max(20, int(np.ceil(span / loop.period)))
    every, (n, m) = -(-ticks // _SAMPLES), loop.B.shape
    step = np.linalg.matrix_power(np.block([[loop.A, loop.B], [np.zeros((m, n)), np.eye(m)]]), every)
    many = replace(loop, A=step[:n, :n].copy(), B=step[:n, n:].copy(), period=every * loop.period)
    return every * loop.period * np.arange(ticks // every + 2.0), many
