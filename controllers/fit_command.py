"""The command `pantograph fit`, which makes keyed motion possible."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..sim.errors import PantographError

console = Console()
SceneFile = Annotated[Path, typer.Argument(help="Scene file (TOML) with keyed joints.")]
WAYS = ("check", "retime", "nearest", "fit")


def fit(
    scene: SceneFile,
    how: Annotated[
        str | None,
        typer.Option(help="check, retime (fastest), nearest (timing), or fit; default: as the scene says."),
    ] = None,
    film: Annotated[
        Path | None, typer.Option(help="Film to write: as keyed on the left, made possible on the right.")
    ] = None,
    velocity: Annotated[
        list[str] | None, typer.Option(help="Limit [rad/s or deg/s, m/s]: 3, or elbow=2.")
    ] = None,
    acceleration: Annotated[list[str] | None, typer.Option(help="Limit [rad/s^2 or deg/s^2, m/s^2].")] = None,
    jerk: Annotated[list[str] | None, typer.Option(help="Limit [rad/s^3 or deg/s^3, m/s^3].")] = None,
    force: Annotated[list[str] | None, typer.Option(help="Limit [N m, N]; default: the model's.")] = None,
    top_speed: Annotated[
        list[str] | None, typer.Option(help="Speed [as velocity] where a motor gives nothing more.")
    ] = None,
    ampere: Annotated[
        list[str] | None, typer.Option(help="Current of a joint's drive [A/(N m), A/N].")
    ] = None,
    current: Annotated[float | None, typer.Option(help="Current that the battery gives [A].")] = None,
    passive: Annotated[
        list[str] | None, typer.Option(help="Joint without a drive, beside free joints.")
    ] = None,
    position: Annotated[
        list[str] | None,
        typer.Option(help="Range of a joint [rad or deg, m]: elbow=-1:2; default: the model's."),
    ] = None,
    hard: Annotated[
        list[float] | None, typer.Option(help="Time of a key to pass through (fit only).")
    ] = None,
    keys: Annotated[
        Path | None, typer.Option(help="File (TOML) for the new motion as tables of keys for a scene.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the recording, and for bare file names.")] = Path(
        "out"
    ),
) -> None:
    """Check the keyed motion of a scene against a machine, or make it possible.

    Machine and contacts stand in the scene's table [fit]; options go before it. Where the scene's angles are
    degrees, so are ranges, speeds, accelerations and jerks of hinges, in [fit] and in options; what is
    printed is in rad, m, N m, N and A. The exit status is 1 for a motion that is not possible, and for a fit
    that strays too far ([fit] within) when it is simulated with the scene's controller, or LQR, in the loop.

    Words of [fit] beside those of options: at_rest (true: begins and ends at rest; false: as fast as keyed;
    default: at rest where the keys are, or are held, else as fast as keyed or slower), effort (weight of
    forces against deviation from the keys; default: 0.001, and possible keys stay as they are), deviation
    (weight of it, 1), step (longest piece of the first grid, 0.04 s), tolerance (of the certificate, 0.001),
    within (0.05 rad or m), and contacts, [[fit.phases]] with sites, start, stop, friction, ground.
    """
    from ..sim.cli import show
    from ..sim.scene.load import load_scene
    from .fit import check
    from .fit.ends import astray_text
    from .fit.task import LIMITS, task_of

    loaded = load_scene(scene)
    how = how or (loaded.fit.how if loaded.fit else "check")
    if how not in WAYS:
        raise PantographError(f"no way {how!r} to fit; there is: {', '.join(WAYS)}")
    texts = dict(zip(LIMITS, (velocity, acceleration, jerk, force, top_speed, ampere), strict=True))
    limits: dict[str, Any] = {word: _limit(word, text) for word, text in texts.items() if text}
    limits |= {"position": dict(map(_range, position))} if position else {}
    task = task_of(loaded, **limits, current=current, passive=passive or None, hard=hard or None)
    clip, phases = task.clip, task.phases
    if not clip.end > clip.start:
        raise PantographError(f"{scene} keys no motion: no joint has two keys")
    if how != "check":
        _check_outputs(out, film, keys)
    report = check(clip, task.machine, phases=phases, at_rest=task.words["at_rest"])
    console.print(_table(report, "as keyed"))
    _advise(report, task)
    if how == "check":
        raise typer.Exit(0 if report.possible else 1)
    if lost := astray_text(task.machine, clip, phases):
        raise PantographError(f"nothing is searched: {lost}")
    if how == "fit":
        with show.status(f"fitting {scene.stem}") as tell:
            found = _fit(task, tell)
        good = found.certificate.holds
    else:
        with show.status(f"retiming {scene.stem}"):
            found = _retime(task, how == "nearest")
        good = found.report.possible
    before, after = _recording(task.plan, clip), _recording(task.plan, found.clip)
    console.print(f"recording: {after.save(out / f'{scene.stem}.fit.npz')}")
    if keys is not None:
        _write_keys(found.clip, scene, _inside(out, keys), loaded.angle == "degree")
    if how == "fit":
        with show.status(f"simulating {scene.stem}"):
            good = _prove(task, found) and good
    if film is not None:
        from ..sim.shoot import shoot

        with show.film_notes(console):
            made = shoot(before, _inside(out, film), beside=after)
        console.print(f"film: {made}, as keyed on the left")
    raise typer.Exit(0 if good else 1)


def _inside(out: Path, file: Path) -> Path:
    return out / file if file.parent == Path() else file


def _check_outputs(out: Path, film: Path | None, keys: Path | None) -> None:
    """Raise PantographError for files that cannot be written, before work is spent on them."""
    from ..sim.film import check_path
    from .tables import check_outputs

    files = [] if keys is None else [_inside(out, keys)]
    if film is not None:
        check_path(_inside(out, film))
        files += [_inside(out, film)] if film.suffix else []  # else a folder of pictures
    for folder in {out, *(file.parent for file in files)}:
        check_outputs(folder, [file for file in files if file.parent == folder])


def _fit(task: Any, tell: Any) -> Any:
    from .fit import fit as solve

    found = solve(task.clip, task.machine, hard=task.hard, phases=task.phases, progress=tell, **task.words)
    if found.certificate.iterations or found.deviation:
        console.print(f"fitted: up to {found.deviation:.3g} rad or m from the keys")
    else:
        console.print("fitted: the keys stay as they are, since they are possible")
    console.print(str(found.certificate), soft_wrap=True, style="" if found.certificate.holds else "yellow")
    return found


def _prove(task: Any, found: Any) -> bool:
    """Whether the simulated motion stays near the fitted one."""
    from .fit import prove

    controller, long = task.controller, found.clip.end - found.clip.start
    delay = controller.parameters.get("delay", 0.0) if controller else 0.0
    if isinstance(delay, int | float) and delay >= long:
        console.print(
            f"[yellow]note:[/] no force comes in time: the controller's delay of {delay:g} s is as long as "
            f"the motion, {long:g} s, or longer",
            soft_wrap=True,
        )
    proof = prove(found, task.machine, controller=controller, within=task.within)
    console.print(str(proof), soft_wrap=True, style="" if proof.holds else "yellow")
    return bool(proof.holds)


def _retime(task: Any, keep: bool) -> Any:
    from .fit import retime

    found = retime(task.clip, task.machine, keep=keep, at_rest=task.words["at_rest"])
    was = task.clip.end - task.clip.start
    console.print(_table(found.report, "retimed"))
    console.print(f"retimed: {found.duration:.4f} s, was {was:.4f} s")
    _tell_stops(found)
    if task.phases:
        console.print(
            "[yellow]note:[/] retiming knows no contacts: what \\[[fit.phases]] would carry is left to the "
            "drives; --how fit counts it",
            soft_wrap=True,
        )
    return found


def _write_keys(clip: Any, scene: Path, file: Path, degree: bool) -> None:
    from .fit.keys import as_keys

    found = as_keys(clip, degree=degree)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"# Made possible from {scene.name}: in place of its keys of these joints.\n{found.text}")
    console.print(f"keys: {file}, {found.rows} a joint, within {found.error:.1e} rad or m of the motion")


def _tell_stops(found: Any) -> None:
    """Where the path makes the machine stop, and what would not."""
    for stop in found.stops[:8]:
        console.print(f"stops at {stop.t:.3f} s (keys: {stop.s:.3f} s): {escape(stop.why)}", soft_wrap=True)
    if len(found.stops) > 8:
        console.print(f"and at {len(found.stops) - 8} more")
    if found.stops:
        console.print(
            '[yellow]note:[/] no motion passes there without a stop: smoother keys (curve = "natural" or '
            '"clamped") or --how fit, which may leave the path, need none',
            soft_wrap=True,
        )
    if found.slowed > 1.05:
        console.print(
            f"[yellow]note:[/] slowed by {found.slowed - 1.0:.0%} as a whole for limits between points of "
            "the path, where it turns sharply: a faster timing exists",
            soft_wrap=True,
        )


def _table(report: Any, title: str) -> Table:
    """Every limit of the machine, the worst first; ranges and missing forces where they are crossed."""
    verdict = "possible" if report.possible else "impossible"
    table = Table(title=f"{title}: {verdict}", title_justify="left", box=SIMPLE, pad_edge=False)
    for head in ("joint", "what", "largest", "limit", "in use", "at s", "crossed"):
        right = head not in ("joint", "what")
        table.add_column(head, justify="right" if right else "left", no_wrap=True)
    little = 0
    for use in report.uses:
        crossed = use.share > 1.0 + 1e-6
        value, limit, share = f"{use.value:.4g}", f"{use.limit:.4g}", f"{use.share:.1%}"
        kind = "no drive" if use.kind == "missing force" else use.kind
        if use.kind in ("position", "missing force"):
            limit, share = ("range", "beyond") if use.kind == "position" else ("0", "")
        if use.kind.endswith("jump"):
            limit, share = "0", ""
        if not crossed and (use.share < 0.01 or use.kind in ("position", "missing force")):
            little += use.kind != "missing force"
            continue
        ends = f"{use.start:.2f}-{use.stop:.2f}" if crossed else ""
        row = (escape(use.who), kind, value, limit, share, f"{use.t:.3f}", ends)
        table.add_row(*row, style="red" if crossed else "")
    if little:
        table.caption = f"and {little} limits that hold, ranges or less than 1 % in use"
        table.caption_justify = "left"
    return table


def _advise(report: Any, task: Any) -> None:
    """What to write where a report would puzzle."""
    from .fit.ends import astray_text
    from .fit.task import unlimited

    notes = []
    if not report.uses:
        notes.append(
            "this machine has no limits: give some, as --velocity 3 --force shoulder=10, or in the "
            "scene's [fit]"
        )
    notes += unlimited(task)
    if not task.phases and any(v.kind == "missing force" and "." in v.who for v in report.violations):
        notes.append(
            "nothing drives a free joint: what carries it is declared as contacts, [[fit.phases]] with "
            "sites, start and stop"
        )
    if lost := astray_text(task.machine, task.clip, task.phases):
        notes.append(lost)
    ends = (task.clip.start, task.clip.end)
    jumps = [v for v in report.violations if v.kind == "speed jump"]
    if any(v.t in ends for v in jumps):
        notes.append(
            "the keys move where the motion is to begin or end at rest, as [fit] at_rest says or since "
            'they are held there: curve = "clamped" rests at its ends'
        )
    if any(v.t not in ends for v in jumps):
        notes.append('no machine turns a corner at speed; curves "auto", "natural" and "clamped" have none')
    for note in notes:
        console.print(f"[yellow]note:[/] {escape(note)}", soft_wrap=True)


def _recording(plan: Any, clip: Any) -> Any:
    """The motion of a clip as a recording, every joint keyed."""
    from dataclasses import replace

    import numpy as np

    from ..sim.engines.interface import Role
    from ..sim.plan import Choice
    from ..sim.run import run

    roles = np.full_like(plan.problem.roles, Role.KEYED)
    h = 1.0 / 240.0
    steps = max(1, math.ceil(clip.end / h - 1e-9))
    problem = replace(plan.problem, clip=clip, roles=roles, duration=steps * h, step=h, sample_every=1)
    kinematic = Choice("kinematic", "the motion is known")
    setup = replace(plan.setup, roles=roles, clip=clip)
    return run(replace(plan, setup=setup, problem=problem, engine=kinematic, period=None))


def _range(text: str) -> tuple[str, tuple[float, float]]:
    """A joint and its range from a text such as elbow=-1:2."""
    name, _, ends = text.rpartition("=")
    try:
        low, high = (float(end) for end in ends.split(":"))
    except ValueError:
        raise PantographError(f"--position is JOINT=low:high, not {text!r}") from None
    return name, (low, high)


def _limit(what: str, texts: list[str]) -> dict[str, float]:
    """Limits by joint from texts such as elbow=2; one without a name stands for all others, as ""."""
    named: dict[str, float] = {}
    for text in texts:
        name, _, value = text.rpartition("=")
        option = f"--{what.replace('_', '-')}"
        try:
            number = float(value)
        except ValueError:
            raise PantographError(f"{option} is a number, or JOINT=number, not {text!r}") from None
        if name in named:
            raise PantographError(
                f"{option} is given twice for {f'joint {name!r}' if name else 'all joints'}"
            )
        named[name] = number
    return named
