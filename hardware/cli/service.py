"""Commands that set up single servos and look after a rig."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from ..errors import HardwareError
from ..rig import Rig, load_rig
from .common import BaudOption, PortOption, RigFile, app, bar, console, driver_of


@app.command(epilog="Example: pantograph servo scan /dev/ttyUSB0")
def scan(
    port: Annotated[str, typer.Argument(help="Serial device.")],
    baud: Annotated[list[int] | None, typer.Option(help="Bit rate to try; repeat for several.")] = None,
) -> None:
    """Find servos at every bit rate; takes about a second for each."""
    from ..registers import BAUD_RATES

    with driver_of(port, 1_000_000) as driver:
        rates = baud or list(BAUD_RATES.values())
        with bar("scanning", len(rates)) as advance:
            found = driver.scan(rates, progress=lambda rate: advance(rates.index(rate)))
    table = Table("ID", "model", "firmware", "bit/s", title=f"servos on {port}")
    for f in found:
        table.add_row(str(f.id), f.model, str(f.firmware), f"{f.baud:,}")
    console.print(table if found else f"no servo answered on {port}: is it powered, its cable in?")
    if not found:
        raise typer.Exit(1)


@app.command(epilog="Example: pantograph servo monitor wx250s --port /dev/ttyUSB0")
def monitor(
    rig: RigFile,
    port: PortOption = None,
    seconds: Annotated[float, typer.Option(help="How long; 0 shows one table.")] = float("inf"),
    rate: Annotated[float, typer.Option(help="Looks a second.")] = 10.0,
) -> None:
    """Live table of a rig: position, goal, velocity, current, temperature, voltage, errors, loop rate."""
    from ..connect import connect
    from ..service import look

    loaded = load_rig(rig)
    driver, note = connect(loaded, port=port, paced=True)
    console.print(f"[dim]{escape(note)}")
    try:
        for id in loaded.ids:
            driver.ping(id)
        begin = driver.clock.now()
        with Live(console=console, refresh_per_second=rate) as live:
            last, hz = begin, 0.0
            while True:
                states = look(driver, list(loaded.ids))
                now = driver.clock.now()
                if now > last:
                    hz = 0.8 * hz + 0.2 / (now - last) if hz else 1 / (now - last)
                last = now
                live.update(_monitor_table(loaded, states, hz))
                if now - begin >= seconds:
                    break
                driver.clock.sleep_until(now + 1 / rate)
    finally:
        driver.close()


def _monitor_table(rig: Rig, states: dict[int, Any], hz: float) -> Table:
    from ..registers import control_table

    table = Table(title=f"{rig.name}, {hz:.1f} looks a second")
    for name in ("ID", "servo", "joint"):
        table.add_column(name, no_wrap=True)
    for name in (
        "position\ndeg",
        "goal\ndeg",
        "speed\ndeg/s",
        "load",
        "temp\ndegC",
        "supply\nV",
        "torque",
        "error",
    ):
        table.add_column(name, justify="right")
    for servo in rig.servos:
        head = (str(servo.id), servo.name, ", ".join(rig.joints_of(servo.name)))
        state = states.get(servo.id)
        if state is None:
            table.add_row(*head, *[""] * 7, "[red]no answer")
            continue
        has_current = control_table(servo.model).has_current
        load = f"{state.load * 1e3:.0f} mA" if has_current else f"{state.load * 100:.1f} %"
        table.add_row(
            *head,
            f"{np.degrees(state.position):.2f}",
            f"{np.degrees(state.goal):.2f}",
            f"{np.degrees(state.velocity):.1f}",
            load,
            f"{state.temperature:.0f}",
            f"{state.voltage:.1f}",
            "on" if state.torque else "off",
            f"[red]{state.errors}" if state.errors else "",
        )
    return table


@app.command("set-id", epilog="Example: pantograph servo set-id /dev/ttyUSB0 1 7")
def set_id(
    port: Annotated[str, typer.Argument(help="Serial device.")],
    old: Annotated[int, typer.Argument(help="Present ID.")],
    new: Annotated[int, typer.Argument(help="New ID, 0 to 252.")],
    baud: BaudOption = 1_000_000,
) -> None:
    """Change the ID of a servo."""
    from .. import service

    with driver_of(port, baud) as driver:
        service.set_id(driver, old, new)
    console.print(f"servo {old} is servo {new} now")


@app.command("set-baud", epilog="Example: pantograph servo set-baud /dev/ttyUSB0 7 1000000 --baud 57600")
def set_baud(
    port: Annotated[str, typer.Argument(help="Serial device.")],
    id: Annotated[int, typer.Argument(help="ID of the servo.")],
    new: Annotated[int, typer.Argument(help="New bit rate.")],
    baud: BaudOption = 57_600,
) -> None:
    """Change the bit rate of a servo."""
    from .. import service

    with driver_of(port, baud) as driver:
        service.set_baud(driver, id, new)
    console.print(f"servo {id} speaks at {new:,} bit/s now")


@app.command(epilog="Example: pantograph servo stop wx250s --limp")
def stop(
    rig: RigFile,
    port: PortOption = None,
    limp: Annotated[bool, typer.Option("--limp", help="Torque off; a raised arm drops.")] = False,
) -> None:
    """Stop a rig: hold where it is, or let it go. This is a word over a cable, no power cut."""
    from ..connect import connect
    from ..mirror.contract import freeze, release, sentences

    loaded = load_rig(rig)
    driver, _ = connect(loaded, port=port)
    try:
        known = [f.id for f in driver.broadcast_ping().values()]
        for servo in loaded.servos:
            if servo.id not in known:  # stop it all the same, by the model that the file says
                from ..registers import control_table

                driver.tables[servo.id] = control_table(servo.model)
        failed = release(driver, loaded) if limp else freeze(driver, loaded, at_present=True)
    finally:
        driver.close()
    for text in sentences(loaded, failed):
        console.print(f"[red]{escape(text)}")
    if failed:
        console.print("[bold]cut the power if it still moves")
        raise typer.Exit(1)
    console.print("limp: torque is off" if limp else "holds; torque stays on and warms the servos")


@app.command(epilog="Example: pantograph servo calibrate /dev/ttyUSB0 wx250s my_arm.toml")
def calibrate(
    port: Annotated[str, typer.Argument(help="Serial device.")],
    model: Annotated[str, typer.Argument(help="Model that the rig embodies: built-in name or file.")],
    out: Annotated[Path, typer.Argument(help="Rig file to write.")],
    joint: Annotated[list[str] | None, typer.Option(help="Joint to calibrate; default: all.")] = None,
    baud: BaudOption = 1_000_000,
) -> None:
    """Walk through the joints by hand and write the rig file."""
    from ...models import load_model
    from ...models.naming import joint_names
    from ...sim.kinds import SCALAR
    from .. import calibrate as by_hand

    if out.exists():
        raise HardwareError(f"{out} exists; choose another name, or remove it first")
    robot = load_model(model)
    scalar = [name for name, kind in zip(joint_names(robot), robot.jnt_type, strict=True) if kind in SCALAR]
    with driver_of(port, baud) as driver:
        found = list(driver.broadcast_ping().values())
        if not found:
            raise HardwareError(
                f"no servo answers on {port} at {baud:,} bit/s; 'pantograph servo scan {port}'"
            )
        with Live(console=console, refresh_per_second=10) as live:
            person = _AtTheTerminal(live)
            result = by_hand.calibrate(driver, found, joint or scalar, person)
    name = out.stem.replace(" ", "_")
    text = by_hand.rig_text(name, model, robot, found, result, port=port, baud=baud)
    out.write_text(text, encoding="utf-8")
    load_rig(out)
    console.print(f"wrote {out}; try it: pantograph servo monitor {out}")


class _AtTheTerminal:
    """A person who presses Enter when done."""

    def __init__(self, live: Live) -> None:
        self._live, self._request = live, ""
        self._done = threading.Event()

    def ready(self, request: str) -> bool:
        """See Person."""
        if request != self._request:
            self._request = request
            self._done.clear()
            self._live.console.print(f"[bold]{escape(request)}[/], then press Enter")
            threading.Thread(target=self._wait, daemon=True).start()
        time.sleep(0.03)
        if self._done.is_set():
            self._request = ""
            return True
        return False

    def _wait(self) -> None:
        sys.stdin.readline()
        self._done.set()

    def show(self, names: Sequence[str], position: Any, low: Any, high: Any) -> None:
        """See Person."""
        table = Table("servo", "lowest", "now", "highest")
        for name, *values in zip(names, low, position, high, strict=True):
            table.add_row(name, *(f"{np.degrees(v):.1f} deg" for v in values))
        self._live.update(table)
