"""Pictures of a loop: Bode plot with margins, root locus, step response. They return matplotlib figures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from .analysis import closed_loop, loop_response, margins, root_locus, step_info, step_response
from .linear import LinearSystem

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
    top.semilogx(w, 20.0 * np.log10(np.abs(L)))
    phase = np.degrees(np.unwrap(np.angle(L)))
    if np.isfinite(found.phase):  # of the turns that an angle leaves open, those that show the margin
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
    slowest = -poles.real.max() if system.period is None else -np.log(np.abs(poles).max()) / system.period
    t = np.linspace(0.0, 6.0 / max(float(slowest), 1e-6), 600)
    if system.period is not None:
        t = system.period * np.arange(float(np.ceil(t[-1] / system.period)) + 1.0)
    row = np.zeros(len(loop.A))
    row[output] = 1.0
    y = step_response(loop, row, t, input=input)
    info = step_info(t, y)
    chart = Figure(figsize=(8, 4), layout="constrained")
    ax = chart.subplots()
    ax.plot(t, y)
    ax.axhspan(0.98 * info.final, 1.02 * info.final, color="grey", alpha=0.2)
    ax.set_xlabel("time [s]")
    ax.set_ylabel(f"{system.states[output]} for 1 N or N m")
    ax.set_title(
        f"rise {info.rise:.3g} s, settling {info.settling:.3g} s, overshoot {info.overshoot:.1%}", fontsize=10
    )
    ax.grid(alpha=0.3)
    return chart
