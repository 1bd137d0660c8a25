"""What the commands for servos share: options, the console, ports, progress, endings."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from ..errors import HardwareError
from ..rig import VIRTUAL, Stop

app = typer.Typer(name="servo", help="Dynamixel servos and rigs, real or virtual.", no_args_is_help=True)
console = Console()

RigFile = Annotated[str, typer.Argument(help="Rig file (TOML), or the name of one that comes along: wx250s.")]
PortOption = Annotated[
    str | None, typer.Option(help="Serial device in place of the rig's, or 'virtual' for servos in memory.")
]
StopOption = Annotated[str, typer.Option(help="How the rig is left: hold, park (then limp) or limp.")]
TakeOver = Annotated[bool, typer.Option("--take-over", help="Accept servos whose torque is on already.")]
Paced = Annotated[bool, typer.Option("--paced", help="Virtual servos take real time.")]
BaudOption = Annotated[int, typer.Option(help="Bit rate of the port.")]


def finish(report: Any) -> None:
    """Exit status of a report: 0 done, 1 fault, 130 interrupted."""
    if report.status != "done":
        raise typer.Exit(130 if report.status == "interrupted" else 1)


def stop_word(word: str) -> Stop:
    """The stop that a word of the command line means."""
    words: dict[str, Stop] = {"hold": "hold", "park": "park", "limp": "limp"}
    if word in words:
        return words[word]
    raise HardwareError(f"no stop {word!r}; there are: hold, park, limp")


@contextmanager
def driver_of(port: str, baud: int) -> Iterator[Any]:
    """Driver of a bare serial port."""
    from ..connect import open_driver

    if port == VIRTUAL:
        raise HardwareError(
            "virtual servos in memory belong to a rig; 'pantograph servo simulate' gives a port"
        )
    driver, note = open_driver(port, baud)
    console.print(f"[dim]{escape(note)}")
    try:
        yield driver
    finally:
        driver.close()


@contextmanager
def bar(what: str, total: float | None, *, to: Console | None = None) -> Iterator[Any]:
    """A progress bar with the time left; yields a function that takes how far it is."""
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=to or console, transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)


@contextmanager
def terminable() -> Iterator[None]:
    """A polite kill (SIGTERM, SIGHUP) stops the rig as Ctrl-C does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    signals = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = [signal.signal(s, interrupt) for s in signals]
    try:
        yield
    finally:
        for s, old in zip(signals, before, strict=True):
            signal.signal(s, old)
