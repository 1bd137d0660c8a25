"""Commands and their exit codes: 0 done, 1 the run failed, 2 wrong input, 130 interrupted."""

from __future__ import annotations

import errno
import json
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from ...controllers.cli import control, gains
from ...controllers.fit_command import fit
from ...hardware.cli import app as servo
from ..errors import PantographError, RunError
from . import show
from .ik import ik
from .template import TEMPLATE

app = typer.Typer(
    name="pantograph",
    help="Key, simulate, film and mirror articulated structures.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
_SURROUNDINGS = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.ENAMETOOLONG,
    errno.EIO,
)
"""Numbers of OSErrors that are no mistake of the program."""

console = Console()
errors = Console(stderr=True)

SceneFile = Annotated[Path, typer.Argument(help="Scene file (TOML); see 'pantograph new'.")]
RecordingFile = Annotated[Path, typer.Argument(help="Recording (.npz) made by 'pantograph run'.")]


def run_app() -> None:
    """Run the command line; mistakes are told in words, without a traceback."""
    try:
        app()
    except PantographError as e:
        errors.print(f"[bold red]error:[/] {escape(str(e))}", highlight=False, soft_wrap=True)
        sys.exit(2)
    except OSError as e:
        if e.errno not in _SURROUNDINGS:
            raise
        where = f"{e.filename}: " if e.filename else ""
        errors.print(f"[bold red]error:[/] {escape(f'{where}{e.strerror}')}", highlight=False, soft_wrap=True)
        if not e.filename:  # standard output: what it did not take is not tried again at the end
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.exit(1)
    except KeyboardInterrupt as e:
        _tell_interrupt(e)
        sys.exit(130)
    except SystemExit as e:
        _tell_interrupt(e)
        raise


def _tell_interrupt(error: BaseException | None) -> None:
    """Say what Ctrl-C left, if it is behind an error; typer makes a silent exit of it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    if error is not None:
        errors.print(
            "; ".join(["interrupted", *getattr(error, "__notes__", ())]), highlight=False, soft_wrap=True
        )


@app.command(epilog="Example: pantograph run wave.toml --film wave.mp4 --plot wave.png --error")
def run(
    scene: SceneFile,
    film: Annotated[Path | None, typer.Option(help="Film to write: .mp4, .gif, or a folder of PNG.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Plot to write: .png, .svg or .pdf.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the recording, and for bare file names.")] = Path(
        "out"
    ),
    error: Annotated[
        bool, typer.Option("--error", help="Estimate the error by a run at half the step.")
    ] = False,
    mirror: Annotated[
        str | None, typer.Option(help="Rig file, or name of one that comes along, to play the motion on.")
    ] = None,
    port: Annotated[
        str | None, typer.Option(help="Mirror: serial device in place of the rig's, or 'virtual'.")
    ] = None,
    slow: Annotated[bool, typer.Option("--slow", help="Mirror: slow the motion down until it fits.")] = False,
    stop: Annotated[str, typer.Option(help="Mirror: how the rig is left: hold, park or limp.")] = "hold",
    take_over: Annotated[
        bool, typer.Option("--take-over", help="Mirror: accept servos whose torque is on already.")
    ] = False,
    live: Annotated[
        bool,
        typer.Option("--live", help="Mirror: follow the simulation while it runs, unchecked beforehand."),
    ] = False,
) -> None:
    """Run a scene; its recording is always saved."""
    from ..plan import make_plan
    from ..run import run as run_scene

    plan = make_plan(scene)
    options: dict[str, Any] = {"port": port, "stop": stop, "take_over": take_over}
    rig_motion = out / f"{scene.stem}-rig.npz"
    if live:
        if mirror is None:
            raise PantographError("--live follows a simulation on a rig: name it with --mirror RIG")
        _mirror(plan, mirror, rig_motion, options | {"live": True})
        return
    _foresee(plan, out, film, mirror)
    with show.progress(f"simulating {scene.stem}", plan.problem.duration) as advance:
        try:
            recording = run_scene(plan, error=error, progress=advance)
        except RunError as e:
            recording = e.recording
    saved = recording.save(out / f"{scene.stem}.npz")
    console.print(show.summary(recording))
    show.notes(console, recording)
    console.print(f"recording: {saved}")
    if recording.status == "done" or len(recording.t) > 1:
        _draw(recording, film, plot, out)
    _finish(recording)
    if mirror is not None:
        _mirror(recording, mirror, rig_motion, options | {"slow": slow})


@app.command(epilog="Example: pantograph plan wave.toml")
def plan(scene: SceneFile) -> None:
    """Explain how a scene will be computed, what is left out, and what would be cheaper."""
    from ..gain import gain_without_contacts
    from ..plan import make_plan

    made = make_plan(scene)
    with show.status("measuring what contacts cost"):
        gain = gain_without_contacts(made)
    show.plan(console, made, gain)


@app.command(epilog="Example: pantograph film out/wave.npz wave.gif --camera side")
def film(
    recording: RecordingFile,
    path: Annotated[Path, typer.Argument(help="Film: .mp4, .gif, a folder, or a picture with --at.")],
    camera: Annotated[str | None, typer.Option(help="Camera of the scene or the model file.")] = None,
    fps: Annotated[float | None, typer.Option(help="Frames per second.", min=0.1, max=1000)] = None,
    size: Annotated[str | None, typer.Option(help="Picture size, as 640x480.")] = None,
    shadows: Annotated[bool | None, typer.Option(help="Draw shadows; default as the scene says.")] = None,
    at: Annotated[float | None, typer.Option(help="One picture at this time [s] instead of a film.")] = None,
    beside: Annotated[
        Path | None, typer.Option(help="Another recording of the same model, such as a rig's, to the right.")
    ] = None,
) -> None:
    """Film a recording without simulating again."""
    from ..recording import load
    from ..shoot import shoot

    options: dict[str, Any] = {
        "camera": camera,
        "fps": fps,
        "size": _size(size),
        "shadows": shadows,
        "at": at,
    }
    if beside is not None:
        options["beside"] = load(beside)
    with show.film_notes(console):
        written = shoot(load(recording), path, **options)
    console.print(f"film: {written}")


@app.command(epilog="Example: pantograph plot out/wave.npz wave.png --joint shoulder --joint elbow")
def plot(
    recording: RecordingFile,
    path: Annotated[Path, typer.Argument(help="Plot: .png, .svg or .pdf.")],
    joint: Annotated[
        list[str] | None, typer.Option(help="Joint to draw; default: those that move most.")
    ] = None,
) -> None:
    """Plot joint positions, velocities, forces and energies against time."""
    from ..plots import plot as draw
    from ..recording import load

    console.print(f"plot: {draw(load(recording), path, joints=joint or ())}")


@app.command(epilog="Example: pantograph new wave.toml")
def new(path: Annotated[Path, typer.Argument(help="Scene file to write.")]) -> None:
    """Write a commented scene to start from."""
    if path.exists():
        raise PantographError(f"{path} exists already; choose another name")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(TEMPLATE)
    except OSError as e:
        raise PantographError(f"cannot write {path}: {e.strerror}") from None
    console.print(f"wrote {path}; next: pantograph run {path} --film {path.stem}.mp4")


@app.command(epilog="Example: pantograph models arm6")
def models(name: Annotated[str | None, typer.Argument(help="A model to describe.")] = None) -> None:
    """List the built-in models, or describe a model: joints, actuators, sites, cameras, keyframes."""
    from ...models import names

    if name is None:
        show.models(console, names())
    else:
        show.model(console, name)


@app.command(epilog="Examples: pantograph report wave.toml; pantograph report --suite hard")
def report(
    scene: Annotated[Path | None, typer.Argument(help="Scene file (TOML).")] = None,
    suite: Annotated[str | None, typer.Option(help="A suite of cases with known ends: 'hard'.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for tables (CSV, JSON, text) and figures.")] = Path("out"),
    engines: Annotated[
        str, typer.Option(help="Of smooth, mujoco, scipy, torch, with commas between them.")
    ] = "smooth,mujoco,scipy",
    limit: Annotated[
        float, typer.Option(help="Seconds after which no run begins (of each case of a suite).", min=0)
    ] = 120.0,
) -> None:
    """Error against cost: engines and methods over steps and tolerances, with a recommendation."""
    from ..report import hard_suite
    from ..report import report as compare

    if (scene is None) == (suite is None):
        raise PantographError("give a scene file, or --suite hard")
    if suite not in (None, "hard"):
        raise PantographError(f"there is no suite {suite!r}; there is: hard")
    names = tuple(name.strip() for name in engines.split(","))
    folder = out / ("hard" if scene is None else f"{scene.stem}-report")
    with show.status("comparing methods") as tell:
        if scene is None:
            reports = hard_suite(folder, engines=names, limit_s=limit, progress=tell)
        else:
            reports = (compare(scene, folder, engines=names, limit_s=limit, progress=tell),)
    for each in reports:
        typer.echo(each.brief())
    console.print(f"report: {folder}")
    if reports[-1].status == "interrupted":
        raise typer.Exit(130)


@app.command(epilog="Example: pantograph schema > scene.schema.json")
def schema() -> None:
    """Print the JSON Schema of scene files, for editors."""
    from ..compose import LAWS
    from ..scene.schema import Scene

    made = Scene.model_json_schema()
    made["$defs"]["ControllerItem"]["properties"]["law"]["enum"] = list(LAWS)
    typer.echo(json.dumps(made, indent=2))


app.add_typer(servo)
app.command(epilog="Example: pantograph ik arm6 --site tip --to 0.4,0.1,0.5 --film reach.mp4")(ik)
app.command(epilog="Example: pantograph control wave.toml --compare pd,computed-torque")(control)
app.command(epilog="Example: pantograph gains wave.toml --law lqr")(gains)
app.command(epilog="Example: pantograph fit wave.toml")(fit)


def _foresee(plan: Any, out: Path, film: Path | None, rig: str | None) -> None:
    """Find before the work what would spoil its end."""
    from ..recording import check_writable

    check_writable(out)
    if film is not None:
        from ..film import check_path
        from ..film.context import Context

        check_path(_in(out, film))
        Context().close()
    if rig is not None:
        from ...hardware.rig import check_model, load_rig

        check_model(load_rig(rig), plan.problem.model)


def _mirror(motion: Any, rig: str, path: Path, options: dict[str, Any]) -> None:
    from ...hardware.cli import play_recording

    report = play_recording(motion, rig, **options)
    if report.recording is not None:
        console.print(f"the rig's recording: {report.recording.save(path)}")
    if report.status != "done":
        raise typer.Exit(130 if report.status == "interrupted" else 1)


def _draw(recording: Any, film_path: Path | None, plot_path: Path | None, out: Path) -> None:
    if plot_path is not None:
        from ..plots import plot as draw

        console.print(f"plot: {draw(recording, _in(out, plot_path))}")
    if film_path is not None:
        from ..shoot import shoot

        with show.film_notes(console):
            written = shoot(recording, _in(out, film_path))
        console.print(f"film: {written}")


def _in(out: Path, path: Path) -> Path:
    """A bare file name lands in the output folder, a path where it says."""
    return out / path if path.parent == Path() else path


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise PantographError(f"a size is WIDTHxHEIGHT, as 640x480, not {text!r}")
    return int(width), int(height)


def _finish(recording: Any) -> None:
    if recording.status == "done":
        return
    errors.print(f"[bold red]{recording.status}:[/] {escape(recording.message)}", soft_wrap=True)
    raise typer.Exit(130 if recording.status == "interrupted" else 1)
