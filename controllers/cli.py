"""Commands of the controllers: `pantograph control` compares laws, `pantograph fit` makes motion possible."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from ..sim.errors import PantographError

console = Console()
SceneFile = Annotated[Path, typer.Argument(help="Scene file (TOML) with tracked joints.")]


def control(
    scene: SceneFile,
    compare: Annotated[str, typer.Option(help="Laws, separated by commas: pid,computed-torque,lqr.")] = "",
    sweep: Annotated[list[str] | None, typer.Option(help="Values of a parameter: frequency=2,5,10.")] = None,
    trials: Annotated[int, typer.Option(help="Disturbed runs a law.", min=0)] = 8,
    mass: Annotated[float, typer.Option(help="Masses differ by up to this part.", min=0.0)] = 0.1,
    push: Annotated[
        float, typer.Option(help="Pushes of up to this part of the drives' force.", min=0.0)
    ] = 0.2,
    seed: Annotated[int, typer.Option(help="Of the disturbances.")] = 0,
    processes: Annotated[int | None, typer.Option(help="Processes; default: all processors.", min=1)] = None,
    out: Annotated[Path, typer.Option(help="Folder for the table and the picture.")] = Path("out"),
) -> None:
    """Run a scene under several control laws, as modelled and disturbed, and compare them."""
    from ..sim.compose import LAWS
    from ..sim.scene.load import load_scene
    from . import experiments

    loaded = load_scene(scene)
    own = loaded.controller.law if loaded.controller else "pd"
    laws = [law.strip() for law in compare.split(",") if law.strip()] or [own]
    if unknown := [law for law in laws if law not in LAWS]:
        raise PantographError(f"no law {unknown[0]!r}; there is: {', '.join(sorted(LAWS))}")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(f"controlling {scene.stem}", total=None)
        result = experiments.compare(
            loaded,
            laws,
            sweep=dict(_values(text) for text in sweep or []),
            trials=trials,
            mass=mass,
            push=push,
            seed=seed,
            processes=processes,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    console.print(*_tables(result), sep="\n")
    console.print(f"table: {experiments.write_csv(result, out / f'{scene.stem}.control.csv')}")
    picture = out / f"{scene.stem}.control.png"
    experiments.figure(result).savefig(picture, dpi=120)
    console.print(f"picture: {picture}")


def _values(text: str) -> tuple[str, list[Any]]:
    """A parameter and its values from ``word=a,b,c``; numbers where they are numbers."""
    word, sign, rest = text.partition("=")
    if not (word and sign and rest):
        raise PantographError(f"a sweep is WORD=value,value, as frequency=2,5,10, not {text!r}")
    return word.strip(), [_value(part.strip()) for part in rest.split(",")]


def _value(text: str) -> Any:
    if text in ("true", "false"):
        return text == "true"
    try:
        return float(text)
    except ValueError:
        return text


def _tables(result: Any) -> tuple[Table, Table]:
    """How well each law follows, and what it takes."""
    count = len(result.disturbances)
    well = _columns("law", "RMS", "max", f"worst RMS of {count}", "failed", "settling", "overshoot")
    well.title = "errors over the tracked joints [rad, m], settling [s]"
    cost = _columns("law", "effort", "work J", "saturated", "tick us", "99 % us", "of period")
    cost.title = f"what it takes; period {result.period * 1e3:g} ms"
    for row in result.rows:
        f, name = row.nominal, row.variant.name
        settled = "never" if math.isnan(f.settling) else f"{f.settling:.3f}"
        robust = f"{row.robust:.2e}" if count else "-"
        well.add_row(
            name, f"{f.rms:.2e}", f"{f.worst:.2e}", robust, str(row.failed), settled, f"{f.overshoot:.1%}"
        )
        cost.add_row(
            name,
            f"{f.effort:.4g}",
            f"{f.work:.4g}",
            f"{f.saturated:.1%}",
            f"{f.tick * 1e6:.0f}",
            f"{f.tick99 * 1e6:.0f}",
            f"{f.tick99 / result.period:.1%}",
        )
    return well, cost


def _columns(*heads: str) -> Table:
    table = Table()
    for head in heads:
        table.add_column(head, justify="left" if head == "law" else "right")
    return table


def fit(
    scene: SceneFile,
    how: Annotated[str, typer.Option(help="check, retime (fastest), nearest (timing), or fit.")] = "check",
    velocity: Annotated[list[str] | None, typer.Option(help="Limit [rad/s, m/s]: 3, or elbow=2.")] = None,
    acceleration: Annotated[list[str] | None, typer.Option(help="Limit [rad/s^2, m/s^2].")] = None,
    jerk: Annotated[list[str] | None, typer.Option(help="Limit [rad/s^3, m/s^3].")] = None,
    force: Annotated[list[str] | None, typer.Option(help="Limit [N m, N]; default: the model's.")] = None,
    top_speed: Annotated[
        list[str] | None, typer.Option(help="Speed where a motor gives nothing more.")
    ] = None,
    passive: Annotated[list[str] | None, typer.Option(help="Joint without a drive (fit only).")] = None,
    hard: Annotated[
        list[float] | None, typer.Option(help="Time of a key to pass through (fit only).")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the recording of the new motion.")] = Path("out"),
) -> None:
    """Check the keyed motion of a scene against a machine, or make it possible."""
    from ..sim.plan import make_plan
    from ..sim.scene.load import load_scene
    from . import fit as fitting

    ways = ("check", "retime", "nearest", "fit")
    if how not in ways:
        raise PantographError(f"no way {how!r} to fit; there is: {', '.join(ways)}")
    plan = make_plan(load_scene(scene))
    problem = plan.problem
    driven = _driven(problem.model, passive or [])
    given = {
        "velocity": velocity,
        "acceleration": acceleration,
        "jerk": jerk,
        "force": force,
        "top_speed": top_speed,
    }
    limits: dict[str, Any] = {k: _limit(v) for k, v in given.items()}
    able = fitting.machine(problem.model, driven=driven, **limits)
    report = fitting.check(problem.clip, able)
    console.print("as keyed: " + ("possible" if report.possible else "impossible"))
    for violation in report.violations:
        console.print(f"  {violation}", soft_wrap=True)
    if how == "check":
        raise typer.Exit(0 if report.possible else 1)
    if how == "fit":
        fitted = fitting.fit(problem.clip, able, hard=hard or [])
        clip = fitted.clip
        console.print(
            f"fitted, up to {fitted.deviation:.4g} rad or m from the keys: {fitted.certificate}",
            soft_wrap=True,
        )
        proof = fitting.prove(fitted, able)
        console.print(
            f"simulated with LQR in the loop: within {proof.worst:.3g} rad or m of the fitted motion"
        )
    else:
        retimed = fitting.retime(problem.clip, able, keep=how == "nearest")
        clip = retimed.clip
        was = problem.clip.end - problem.clip.start
        console.print(
            f"retimed: {retimed.duration:.4f} s, was {was:.4f} s; limits in use {retimed.report.worst:.4%}"
        )
    console.print(f"recording: {_record(plan, clip, out / f'{scene.stem}.fit.npz')}")


def _record(plan: Any, clip: Any, path: Path) -> Path:
    """The motion of a clip as a recording, every joint keyed."""
    from dataclasses import replace

    import numpy as np

    from ..sim.engines.interface import Role
    from ..sim.plan import Choice
    from ..sim.run import run

    roles = np.full_like(plan.problem.roles, Role.KEYED)
    h = 1.0 / 240.0
    steps = max(1, math.ceil((clip.end - clip.start) / h))
    problem = replace(plan.problem, clip=clip, roles=roles, duration=steps * h, step=h, sample_every=1)
    kinematic = Choice("kinematic", "the motion is known")
    setup = replace(plan.setup, roles=roles, clip=clip)
    recording = run(replace(plan, setup=setup, problem=problem, engine=kinematic, period=None))
    return recording.save(path)


def _driven(model: Any, passive: list[str]) -> Any:
    """Mask (nv,) of the freedoms with a drive."""
    import numpy as np

    from ..models import lookup

    driven = np.ones(model.nv, dtype=bool)
    for name in passive:
        driven[model.dof_jntid == lookup(model, "joint", name)] = False
    return driven


def _limit(texts: list[str] | None) -> float | dict[str, float] | None:
    """One number for all joints, or one a joint from texts such as elbow=2."""
    if not texts:
        return None
    named = {}
    for text in texts:
        name, sign, value = text.rpartition("=")
        try:
            number = float(value)
        except ValueError:
            raise PantographError(f"a limit is a number, or JOINT=number, not {text!r}") from None
        if not sign:
            return number
        named[name] = number
    return named
