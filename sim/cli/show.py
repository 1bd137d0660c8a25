"""What commands print: tables, notes, progress."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import mujoco
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from ...models import data_robots, load_model, names_of
from ..engines.interface import Drive, Role
from ..errors import FilmWarning
from ..plan import Plan
from ..recording import Recording


@contextmanager
def progress(what: str, total: float) -> Iterator[Callable[[float], None] | None]:
    """A bar with the time left, on a terminal; yields a function that takes how far it is."""
    if not sys.stderr.isatty():
        yield None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.update(task, completed=done)


@contextmanager
def status(what: str) -> Iterator[Callable[[str], None] | None]:
    """A line that tells what is at work, on a terminal; yields a function that takes it."""
    if not sys.stderr.isatty():
        yield None
        return
    with Console(stderr=True).status(what) as line:
        yield lambda at_work: line.update(f"{what}: {at_work}")


def summary(recording: Recording) -> Table:
    """Simulated and wall time, evaluations, energy, error."""
    stats, t = recording.stats, recording.t
    table = Table(title=recording.scene.get("title") or None, show_header=False)
    simulated = float(t[-1] - t[0]) if len(t) else 0.0
    wall = float(stats["wall_s"])
    tolerance = stats.get("tolerance")
    how = f"step {stats['step']:.6g} s" if tolerance is None else f"relative tolerance {tolerance:g}"
    table.add_row("engine", f"{stats['engine']}, {stats['integrator']}, {how}")
    table.add_row("simulated", f"{simulated:.4g} s in {len(t)} samples ({recording.status})")
    table.add_row("wall time", f"{wall:.3g} s, {simulated / wall if wall else np.inf:.3g} times real time")
    if "build_s" in stats:
        found = "code found in the cache" if stats["build_cached"] else "code compiled and cached"
        table.add_row("preparation", f"{stats['build_s']:.3g} s, {found}")
    table.add_row("evaluations", f"{stats['evaluations']}")
    if len(t):
        energy = recording.energy
        largest = float(np.max(np.abs(energy - energy[0])))
        table.add_row("energy", f"{energy[0]:.6g} J at first, changed by at most {largest:.3g} J")
    for kind in ("contact", "limit"):
        begun = [event.what for event in recording.events if event.kind == kind]
        if begun:
            table.add_row(f"{kind}s begun", f"{len(begun)}, {len(set(begun))} different")
    if recording.error is not None:
        table.add_row("estimated error", error_text(recording))
    return table


def error_text(recording: Recording) -> str:
    """The error estimate in words, with how far it can be trusted and what it cost."""
    e = recording.error
    assert e is not None
    text = f"{np.max(e.angle):.3g} rad, {np.max(e.length):.3g} m at most; cost {e.wall_s:.3g} s, "
    text += f"{e.evaluations} evaluations"
    if np.isfinite(e.trusted_until):
        text += (
            f"\norder {e.order} until the first contact or limit at {e.trusted_until:.4g} s; "
            "after it the error is an indication only"
        )
    return text


@contextmanager
def film_notes(console: Console) -> Iterator[None]:
    """Print what a film leaves out as notes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FilmWarning)
        yield
    for warning in caught:
        console.print(f"[yellow]note:[/] {escape(str(warning.message))}", soft_wrap=True)


def notes(console: Console, recording: Recording) -> None:
    """Overlaps and crossed limits that were not simulated."""
    for note in recording.notes[:8]:
        console.print(f"[yellow]note:[/] {escape(note)}", soft_wrap=True)
    if len(recording.notes) > 8:
        console.print(f"[yellow]note:[/] and {len(recording.notes) - 8} more in the recording's notes")


def plan(console: Console, plan: Plan, measured: str | None = None) -> None:
    """The plan with its reasons, and what was ``measured`` for it."""
    table = Table(title=plan.setup.scene.title or None, show_header=False)
    table.add_column(no_wrap=True)
    table.add_row("engine", f"{plan.engine.what}: {plan.engine.why}")
    table.add_row("integrator", f"{plan.integrator.what}: {plan.integrator.why}")
    table.add_row("step", f"{plan.step.what}: {plan.step.why}")
    steps = 0 if plan.engine.what == "kinematic" else plan.problem.steps
    count = f"{steps} steps" if plan.problem.tolerance is None else "as many steps as the tolerance takes"
    table.add_row("work", f"{count}, a sample every {plan.problem.sample_every * plan.problem.step:.4g} s")
    if plan.period is not None:
        item = plan.setup.scene.controller
        table.add_row("controller", f"{item.law if item else 'pd'}, every {plan.period:g} s, held in between")
    for role in (Role.KEYED, Role.TRACKED, Role.PASSIVE):
        joints = plan.joints(role)
        if joints:
            table.add_row(f"{role.name.lower()} joints", escape(", ".join(joints)))
    for name, choice in plan.goals:
        table.add_row(f"goal {escape(name)}", escape(f"{choice.what}: {choice.why}"))
    if plan.setup.coupled:
        table.add_row("coupled", f"{escape(', '.join(plan.setup.coupled))}: follow keyed joints by the model")
    for drive in (Drive.KEYS, Drive.CONTROLLER):
        actuators = plan.actuators(drive)
        if actuators:
            table.add_row(f"actuators by {drive.name.lower()}", escape(", ".join(actuators)))
    for line in plan.notes:
        table.add_row("note", escape(line))
    for line in plan.left_out:
        table.add_row("left out", escape(line))
    for line in plan.cheaper:
        table.add_row("cheaper", escape(line))
    if measured:
        table.add_row("measured", escape(measured))
    console.print(table)


def models(console: Console, names: tuple[str, ...]) -> None:
    """The built-in models."""
    table = Table("model", "joints", "degrees of freedom", "actuators", title="built-in models")
    for name in names:
        m = load_model(name)
        table.add_row(name, str(m.njnt), str(m.nv), str(m.nu))
    console.print(table)
    robots = ", ".join(data_robots())
    if robots:
        console.print(f"robots of the data folder: {robots}", soft_wrap=True)
    console.print("'pantograph models NAME' describes one; any MJCF or URDF file works in a scene as well")


def model(console: Console, name: str) -> None:
    """Names in a model, with the ranges of its joints."""
    m = load_model(name)
    table = Table("joint", "type", "range", title=escape(name))
    for j, joint in enumerate(names_of(m, "joint")):
        kind = mujoco.mjtJoint(int(m.jnt_type[j])).name.removeprefix("mjJNT_").lower()
        low, high = m.jnt_range[j]
        unit = "m" if kind == "slide" else "rad"
        table.add_row(joint, kind, f"{low:.3f} to {high:.3f} {unit}" if m.jnt_limited[j] else "free")
    console.print(table)
    for kind in ("body", "actuator", "site", "camera", "light", "key"):
        found = names_of(m, kind)  # type: ignore[arg-type]
        if found:
            console.print(
                f"{'keyframe' if kind == 'key' else kind}: {escape(', '.join(found))}", soft_wrap=True
            )
