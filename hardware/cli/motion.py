"""Commands that move a rig: by a step, by a recording, by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape

from ..errors import HardwareError
from ..rig import Rig, load_rig
from .common import (
    Paced,
    PortOption,
    RigFile,
    StopOption,
    TakeOver,
    app,
    bar,
    console,
    finish,
    stop_word,
    terminable,
)


@app.command(epilog="Example: pantograph servo jog wx250s elbow -- -10")
def jog(
    rig: RigFile,
    joint: Annotated[str, typer.Argument(help="Joint of the rig.")],
    by: Annotated[float, typer.Argument(help="How far: degrees, or millimetres of a sliding joint.")],
    port: PortOption = None,
    stop: StopOption = "hold",
) -> None:
    """Move one joint a little, slowly; the others hold still. Takes over a rig that holds itself."""
    from ..connect import connect
    from ..errors import unknown
    from ..mapping import joint_bounds
    from ..mirror import Session
    from ..mirror.record import make_report

    loaded = load_rig(rig)
    driver, note = connect(loaded, port=port)
    try:
        session = Session(loaded, driver, stop=stop_word(stop), take_over=True)
        mapping = session.mapping
        if joint not in mapping.joints:
            raise HardwareError(unknown("joint", joint, mapping.joints, where=loaded.name))
        j = mapping.joints.index(joint)
        slides = mapping.units[j] == "m"
        step = by * 1e-3 if slides else np.radians(by)
        bounds = joint_bounds(loaded)

        def first(present: Any) -> Any:
            q = mapping.joint(present)
            new = q.copy()
            new[j] += step
            low, high = bounds.low[j], bounds.high[j]
            if max(low - new[j], new[j] - high) > max(0.0, low - q[j], q[j] - high):
                raise HardwareError(
                    f"joint {joint!r} is at {q[j]:.4f}, its range {low:.4f} to {high:.4f} [rad, m]: "
                    f"{new[j]:.4f} is outside"
                )
            return present + mapping.servo(new) - mapping.servo(q)

        with terminable():
            outcome = session.run(first, lambda t: session.goal, 0.3)
        report = make_report(outcome, loaded, driver, mapping, notes=(note,))
    finally:
        driver.close()
    if report.status == "done":
        text = (
            f"{report.measured[-1, j]:.4f} m" if slides else f"{np.degrees(report.measured[-1, j]):.2f} deg"
        )
        console.print(f"{joint} is at {text}; the rig {report.stop}")
    else:
        console.print(escape(str(report)), highlight=False)
    finish(report)


@app.command(epilog="Example: pantograph servo play out/wave.npz wx250s --stop park")
def play(
    recording: Annotated[Path, typer.Argument(help="Recording (.npz) made by 'pantograph run'.")],
    rig: RigFile,
    slow: Annotated[bool, typer.Option("--slow", help="Slow the whole motion down until it fits.")] = False,
    stop: StopOption = "hold",
    port: PortOption = None,
    take_over: TakeOver = False,
    paced: Paced = False,
    out: Annotated[Path | None, typer.Option(help="Where to save the rig's own recording (.npz).")] = None,
) -> None:
    """Play a recording on a rig, after checking that the rig can make it."""
    from ...sim.recording import check_writable, load

    if out is not None:
        check_writable(out.parent)
    report = play_recording(
        load(recording), rig, slow=slow, stop=stop, port=port, take_over=take_over, paced=paced
    )
    if out is not None and report.recording is not None:
        console.print(f"the rig's recording: {report.recording.save(out)}")
    finish(report)


@app.command(epilog="Example: pantograph servo teleop leader.toml follower.toml")
def teleop(
    leader: RigFile,
    follower: Annotated[str | None, typer.Argument(help="Rig that follows; without, only the model.")] = None,
    seconds: Annotated[float, typer.Option(help="How long; until Ctrl-C without.")] = float("inf"),
    stop: StopOption = "hold",
    leader_port: PortOption = None,
    follower_port: PortOption = None,
    paced: Paced = False,
    out: Annotated[Path | None, typer.Option(help="Where to save the leader's recording (.npz).")] = None,
) -> None:
    """Move a limp rig by hand: the model, and another rig, follow."""
    from ...sim.recording import check_writable
    from ..mirror.teleop import teleoperate

    if out is not None:
        check_writable(out.parent)
    with terminable():
        report = teleoperate(
            leader,
            follower,
            duration=seconds,
            stop=stop_word(stop),
            leader_port=leader_port,
            follower_port=follower_port,
            paced=paced,
        )
    if out is not None and report.recording is not None:
        console.print(f"the leader's recording: {report.recording.save(out)}")
    if report.follower is not None:
        console.print(escape(str(report.follower)), highlight=False)
        finish(report.follower)
    console.print(
        f"{report.status}: {len(report.t)} poses of {', '.join(report.joints)} {escape(report.message)}"
    )
    if report.status == "fault":
        raise typer.Exit(1)


def play_recording(
    recording: Any,
    rig: Rig | str | Path,
    *,
    slow: bool = False,
    stop: str = "hold",
    port: str | None = None,
    take_over: bool = False,
    paced: bool = False,
    live: bool = False,
    to: Console | None = None,
) -> Any:
    """Mirror a recording, or with `live` a scene while it runs; prints and returns the report.

    For `pantograph run SCENE --mirror RIG`. Raises MotionRefused and RigFault as `mirror_recording` does.
    """
    from ..mirror import mirror_live, mirror_recording

    screen = to or console
    loaded = load_rig(rig) if isinstance(rig, str | Path) else rig
    options: dict[str, Any] = {
        "stop": stop_word(stop),
        "port": port,
        "take_over": take_over,
        "paced": paced,
        "on_phase": lambda phase: screen.print(f"[dim]{phase}"),
    }
    length = getattr(recording, "duration", None)
    if length is None:
        length = float(recording.t[-1] - recording.t[0]) if hasattr(recording, "t") else None
    with terminable(), bar(f"mirroring to {loaded.name}", length, to=screen) as advance:
        if live:
            report = mirror_live(recording, loaded, progress=advance, **options)
        else:
            report = mirror_recording(recording, loaded, slow=slow, progress=advance, **options)
    if report.verdict is not None and not report.verdict.ok:
        screen.print(escape(str(report.verdict)), highlight=False)
    screen.print(escape(str(report)), highlight=False)
    return report
