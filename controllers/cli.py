"""The command `pantograph control`, which compares laws."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from ..sim.errors import PantographError

console = Console()
_UNITS = (
    "Where a scene's angles are degrees, rad, rad/s and rad/s^2 are degrees for hinges, also in --sweep and "
    "--start; gains stay as listed. Gains, weights and limits are one number for all joints, or one a joint: "
    'with kp = {elbow = 40}, joints that are not named keep the default; with kp = {"" = 20, elbow = 40}, '
    "they have what all others have, 20."
)
SceneFile = Annotated[Path, typer.Argument(help="Scene file (TOML) with tracked joints.")]


def _list_laws(wanted: bool) -> None:
    """Print every law with its words, and what sensors and drives can be told."""
    if not wanted:
        return
    from .listing import laws

    for entry in laws():
        console.print(f"[bold]{entry.name}[/]: {escape(entry.says)}\n", highlight=False)
        console.print(Padding(escape(entry.about), (0, 0, 0, 4)), highlight=False)
        words = _columns("word", "default", "unit")
        for word in entry.words:
            words.add_row(*map(escape, word))
        console.print(Padding(words, (0, 0, 1, 4)))
    console.print(_UNITS, highlight=False, soft_wrap=True)
    raise typer.Exit


def control(
    scene: SceneFile,
    compare: Annotated[
        str,
        typer.Option(
            help="Laws, separated by commas: pid,computed-torque,lqr,mpc; ilc: the scene's law, learning."
        ),
    ] = "",
    sweep: Annotated[
        list[str] | None, typer.Option(help="Values of a parameter: frequency=2,5,10, or one: site=tip.")
    ] = None,
    trials: Annotated[int, typer.Option(help="Disturbed runs a law.", min=0)] = 8,
    mass: Annotated[float, typer.Option(help="Masses differ by up to this part: 0.1 is 10 %.")] = 0.1,
    friction: Annotated[
        float, typer.Option(help="Damping and dry friction differ by up to this part.")
    ] = 0.0,
    push: Annotated[float, typer.Option(help="Pushes of up to this part of the drives' force.")] = 0.2,
    start: Annotated[
        float, typer.Option(help="Starts off by up to this, in the scene's units, and this a second.")
    ] = 0.0,
    seed: Annotated[int, typer.Option(help="Of the disturbances.", min=0)] = 0,
    processes: Annotated[int | None, typer.Option(help="Processes; default: all processors.", min=1)] = None,
    table: Annotated[str, typer.Option(help="Kind of the saved tables: csv or parquet.")] = "csv",
    out: Annotated[Path, typer.Option(help="Folder for tables and picture.")] = Path("out"),
    laws: Annotated[
        bool, typer.Option("--laws", is_eager=True, callback=_list_laws, help="List laws and their words.")
    ] = False,
) -> None:
    """Run a scene under several control laws, as modelled and disturbed, and compare them."""
    from ..sim.compile.program import workers
    from ..sim.compose import LAWS
    from ..sim.scene.load import load_scene
    from . import experiments, tables
    from .experiments import printed
    from .trial import ILC

    tables.check_format(table)
    loaded = load_scene(scene)
    own = loaded.controller.law if loaded.controller else "pd"
    chosen = [law.strip() for law in compare.split(",") if law.strip()] or [own]
    known = sorted((*LAWS, ILC))
    if unknown := [law for law in chosen if law not in known]:
        raise PantographError(f"no law {unknown[0]!r}; there is: {', '.join(known)}")
    saved = [out / f"{scene.stem}.{part}" for part in (f"control.{table}", f"runs.{table}", "control.png")]
    tables.check_outputs(out, saved)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(f"controlling {scene.stem}", total=None)
        result = experiments.compare(
            loaded,
            chosen,
            sweep=_swept(sweep or []),
            trials=trials,
            mass=mass,
            friction=friction,
            push=push,
            start=start,
            seed=seed,
            processes=processes or max(2, workers()),  # apart from this one, which hears Ctrl-C
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    if result.rows:
        console.print(*printed.tables(result), sep="\n")
    for line in printed.notes(result):
        console.print(escape(line), soft_wrap=True, highlight=False)
    if result.status == "interrupted":
        _leave(result, [path.with_suffix(f".partial{path.suffix}") for path in saved[:2]])
    for path, rows in zip(saved[:2], (tables.summary(result), tables.runs(result)), strict=True):
        console.print(f"table: {tables.save(rows, path)}", soft_wrap=True)
    pictures = {saved[2]: experiments.figure(result)}
    for name, trial in result.trials.items():
        if trial.learned is not None:
            errors = ", ".join(f"{error:.2e}" for error in trial.learned.errors)
            console.print(f"{name}, RMS error of each repeat: {errors}", soft_wrap=True, highlight=False)
            kept = trial.learned.save(out / f"{scene.stem}.{name.replace(' ', '-')}.npz")
            console.print(f"learned forces: {kept} (the controller's word 'learned')", soft_wrap=True)
            pictures[out / f"{scene.stem}.learning.png"] = experiments.learning(result)
    for path, picture in pictures.items():
        picture.savefig(path, dpi=120)
        console.print(f"picture: {path}", soft_wrap=True)
    if result.unfit:
        raise typer.Exit(1)


def _leave(result: Any, paths: list[Path]) -> None:
    """Save what Ctrl-C left of a comparison, and raise it again."""
    from . import tables

    interrupt = KeyboardInterrupt()
    interrupt.add_note(f"{result.done} of {result.asked} runs are done")
    if result.rows:
        for path, rows in zip(paths, (tables.summary(result), tables.runs(result)), strict=True):
            interrupt.add_note(str(tables.save(rows, path)))
    raise interrupt


def _swept(texts: list[str]) -> dict[str, list[Any]]:
    """Values of every parameter; what is given for one in several places belongs together."""
    out: dict[str, list[Any]] = {}
    for word, values in map(_values, texts):
        own = out.setdefault(word, [])
        own += [value for value in values if value not in own]
    return out


def _values(text: str) -> tuple[str, list[Any]]:
    """A parameter and its values from ``word=a,b,c``; numbers where they are numbers."""
    word, sign, rest = text.partition("=")
    if not (word and sign and rest):
        raise PantographError(f"a sweep is WORD=value,value, as frequency=2,5,10, not {text!r}")
    return word.strip(), [_value(part.strip()) for part in rest.split(",")]


def _value(text: str) -> Any:
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def _columns(*heads: str) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for head in heads:
        if head in ("law", "joint", "word", "unit"):
            table.add_column(head, overflow="fold", min_width=14)
        else:
            table.add_column(head, justify="right", no_wrap=True)
    return table


def gains(
    scene: SceneFile,
    law: Annotated[str, typer.Option(help="Law; default: the scene's.")] = "",
    at: Annotated[float, typer.Option(help="Time to look at [s].")] = 0.0,
    joint: Annotated[str, typer.Option(help="Joint to draw; default: the one of least margin.")] = "",
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("out"),
) -> None:
    """Poles, margins and step response of a scene under its law, about its keys (with contacts: its run)."""
    from ..sim.explain import cautions
    from ..sim.plan import make_plan
    from ..sim.recording import check_writable
    from ..sim.scene.angles import law_words
    from ..sim.scene.load import load_scene
    from . import design
    from .design import figures
    from .design.law import loop_of
    from .experiments import told

    check_writable(out)
    loaded = load_scene(scene)
    law = law or (loaded.controller.law if loaded.controller else "pd")
    words, plan = told(loaded, law), make_plan(loaded)
    system, K, says, mechanism = loop_of(plan, law, words, t=at)
    if joint and joint not in system.inputs:
        raise PantographError(f"no tracked joint {joint!r}; there is: {', '.join(system.inputs)}")
    for note in cautions(plan.setup, law, law_words(loaded, plan.problem.model, words)):
        console.print(f"[yellow]note:[/] {escape(note)}", soft_wrap=True, highlight=False)
    console.print(f"linearised {says}", soft_wrap=True, highlight=False)
    verdicts = [design.controllability(mechanism), design.stabilisability(mechanism)]
    if words.get("observer", "none") != "none":
        measured = np.eye(len(mechanism.A))[: len(mechanism.A) // 2]
        verdicts += [design.observability(mechanism, measured), design.detectability(mechanism, measured)]
    for verdict in verdicts:
        console.print(verdict.says, soft_wrap=True, highlight=False)
    found = [design.margins(system, K, input=i) for i in range(len(system.inputs))]
    console.print(_margins(system, found), _poles(design.closed_loop(system, K)), sep="\n")
    least = min(range(len(found)), key=lambda i: found[i].disk)
    chosen = system.inputs.index(joint) if joint else least
    state = system.states.index(system.inputs[chosen])
    pictures = {
        "bode": figures.bode(system, K, input=chosen),
        "locus": figures.locus(system, K),
        "step": figures.step(system, K, state, input=chosen),
    }
    for name, picture in pictures.items():
        path = out / f"{scene.stem}.{name}.png"
        picture.savefig(path, dpi=120)
        console.print(f"picture: {path}", soft_wrap=True)


def _margins(system: Any, found: list[Any]) -> Table:
    table = _columns("joint", "phase deg", "delay ms", "least gain", "most gain", "disk")
    table.title = f"margins of each loop, the others closed, sampled every {system.period * 1e3:g} ms"
    for name, m in zip(system.inputs, found, strict=True):
        if not m.stable:
            table.add_row(name, "unstable", *["-"] * 4)
            continue
        low, up = m.gain
        table.add_row(
            name,
            f"{math.degrees(m.phase):.1f}",
            f"{m.delay * 1e3:.3g}",
            f"{low:.2g}",
            f"{up:.3g}",
            f"{m.disk:.2f}",
        )
    return table


def _poles(loop: Any) -> Table:
    """Closed-loop modes, a pair of poles a row."""
    from .design import modes

    table = _columns("frequency rad/s", "damping", "stable")
    table.title = "closed-loop poles"
    for mode in modes(loop.A, period=loop.period):
        if mode.pole.imag >= 0.0:
            table.add_row(f"{mode.frequency:.4g}", f"{mode.damping:.3f}", "yes" if mode.stable else "NO")
    return table
