"""Plots of a recording against time: joint positions with their keys, velocities, forces, energies, goals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from ..models import name_of
from .engines.interface import Event
from .errors import PantographError, unknown
from .kinds import HINGE, SCALAR, SLIDE
from .recording import Recording
from .scene.schema import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST = 10  # joints drawn when none are named
_LEAST = 1e-9  # [m or rad] off a goal that is drawn


def plot(recording: Recording, path: str | Path, *, joints: Sequence[str] = ()) -> Path:
    """Draw a recording into a file (PNG, SVG or PDF by its ending).

    Of many joints the ten that move most are drawn, unless ``joints`` names some. Raises PantographError for
    a joint that does not exist, an empty recording or a file that cannot be written.
    """
    path = Path(path)
    chart = figure(recording, joints=joints)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        chart.savefig(path, dpi=120)
    except (OSError, ValueError) as e:
        raise PantographError(f"cannot write the plot {path}: {e}") from None
    return path


def figure(recording: Recording, *, joints: Sequence[str] = ()) -> Figure:
    """The plot as a matplotlib figure; see :func:`plot`."""
    from matplotlib.figure import Figure

    if len(recording.t) < 2:
        raise PantographError("the recording has fewer than two samples; there is nothing to plot")
    m, t = recording.model, recording.t
    scalars, left = _chosen(recording, joints)
    panels = 4 + bool(recording.goals)
    chart = Figure(figsize=(10, 2.75 * panels), layout="constrained")
    axes = chart.subplots(panels, 1, sharex=True)
    keys = _keys(recording)
    for colour, j in zip(_colours(len(scalars)), scalars, strict=True):
        iq, iv, name = m.jnt_qposadr[j], m.jnt_dofadr[j], name_of(m, "joint", j)
        role = "keyed" if recording.keyed[iv] else "tracked" if recording.tracked[iv] else "passive"
        style = {"color": colour, "ls": "--" if role == "passive" else "-", "lw": 1.5}
        axes[0].plot(t, recording.q[:, iq], label=f"{name} ({role})", **style)
        axes[1].plot(t, recording.v[:, iv], **style)
        axes[2].plot(t, recording.tau[:, iv], **style)
        if name in keys:
            axes[0].plot(*keys[name], "o", color=colour, mfc="white", ms=5, zorder=3)
    axes[3].plot(t, recording.kinetic, label="kinetic", color="tab:orange")
    axes[3].plot(t, recording.potential, label="potential", color="tab:blue")
    axes[3].plot(t, recording.energy, label="total", color="black", lw=2)
    if recording.goals:
        _missed(recording, axes[4])
    _units(m, scalars, axes)
    title = recording.scene.get("title") or "recording"
    more = f" ({left} joints that move less are not drawn)" if left else ""
    chart.suptitle(f"{title}: {recording.status}{more}")
    for event in _apart(recording.events, (t[-1] - t[0]) / 20):
        if event.kind == "limit":
            axes[0].axvline(event.t, color="tab:red", lw=0.8, alpha=0.6)
        if event.kind == "contact":
            axes[3].axvline(event.t, color="grey", lw=0.6, alpha=0.5)
    if scalars:
        axes[0].legend(fontsize=8, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False)
    axes[3].legend(fontsize=8, loc="best")
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.margins(x=0)
    return chart


def _missed(recording: Recording, ax: Any) -> None:
    """How far the motion is from the goals of its scene."""
    for k, (name, colour) in enumerate(zip(recording.goals, _colours(len(recording.goals)), strict=True)):
        for rows, unit, style in zip(recording.missed[:, k].T, ("m", "rad"), ("-", "--"), strict=True):
            if rows.any():
                ax.plot(recording.t, np.maximum(rows, _LEAST), style, color=colour, label=f"{name} [{unit}]")
    ax.set_yscale("log")
    ax.set_ylabel("off the goals [m or rad]")
    if ax.lines:
        ax.legend(fontsize=8, loc="best")


def _apart(events: Sequence[Event], gap: float) -> list[Event]:
    """Beginnings of contacts and limits, less those that only chatter: again within ``gap`` [s]."""
    found: list[Event] = []
    last: dict[tuple[str, str], float] = {}
    for event in events:
        what = (event.kind.removesuffix(" end"), event.what)
        if event.kind == what[0] and event.t - last.get(what, -np.inf) > gap:
            found.append(event)
        last[what] = event.t
    return found


def _chosen(recording: Recording, names: Sequence[str]) -> tuple[list[int], int]:
    """Scalar joints to draw, and how many others there are."""
    m = recording.model
    scalars = {name_of(m, "joint", j): j for j in range(m.njnt) if int(m.jnt_type[j]) in SCALAR}
    for name in names:
        if name not in scalars:
            raise PantographError(unknown("hinge or slide joint", name, scalars, where="the recording"))
    if names:
        return [scalars[n] for n in names], 0
    reach = {j: float(np.ptp(recording.q[:, m.jnt_qposadr[j]])) for j in scalars.values()}
    most = sorted(sorted(reach, key=lambda j: -reach[j])[:_MOST])
    return most, len(scalars) - len(most)


def _keys(recording: Recording) -> dict[str, tuple[Any, Any]]:
    """Times and values [rad, m] of the keys of scalar joints."""
    scene, m = Scene(**recording.scene), recording.model
    out = {}
    for item in scene.keys:
        if item.joint is None or item.channel in ("position", "rotation") or not np.isscalar(item.values[0]):
            continue
        joint = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_JOINT, item.joint)
        hinge = joint >= 0 and m.jnt_type[joint] == HINGE
        scale = np.pi / 180 if hinge and scene.angle == "degree" else 1.0
        times, values = np.asarray(item.times), scale * np.asarray(item.values, dtype=float)
        shown = times <= recording.t[-1]
        out[item.joint] = (times[shown], values[shown])
    return out


def _units(m: mujoco.MjModel, scalars: list[int], axes: Any) -> None:
    kinds = {int(m.jnt_type[j]) for j in scalars}
    angle, length = ("rad", "rad/s", "N m"), ("m", "m/s", "N")
    if kinds == {SLIDE}:
        units = length
    elif len(kinds) == 2:
        units = tuple(f"{a} or {b}" for a, b in zip(angle, length, strict=True))  # type: ignore[assignment]
    else:
        units = angle
    for ax, what, unit in zip(axes, ("position", "velocity", "drive force"), units, strict=False):
        ax.set_ylabel(f"{what} [{unit}]")
    axes[3].set_ylabel("energy [J]")
    axes[-1].set_xlabel("time [s]")


def _colours(n: int) -> list[Any]:
    from matplotlib import colormaps

    return [colormaps["tab10"](i % 10) for i in range(n)]
