"""Commands for servos and rigs: `pantograph servo ...`."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from .errors import HardwareError
from .rig import VIRTUAL, Rig, Stop, find_rig, load_rig

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


@app.command(epilog="Example: pantograph servo scan /dev/ttyUSB0")
def scan(
    port: Annotated[str, typer.Argument(help="Serial device.")],
    baud: Annotated[list[int] | None, typer.Option(help="Bit rate to try; repeat for several.")] = None,
) -> None:
    """Find servos at every bit rate; takes about a second for each."""
    from .registers import BAUD_RATES

    with _driver(port, 1_000_000) as driver:
        rates = baud or list(BAUD_RATES.values())
        with _bar("scanning", len(rates)) as advance:
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
    from .connect import connect
    from .service import look

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
    from .registers import control_table

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


@app.command(epilog="Example: pantograph servo jog wx250s elbow -- -10")
def jog(
    rig: RigFile,
    joint: Annotated[str, typer.Argument(help="Joint of the rig.")],
    by: Annotated[float, typer.Argument(help="How far: degrees, or millimetres of a sliding joint.")],
    port: PortOption = None,
    stop: StopOption = "hold",
) -> None:
    """Move one joint a little, slowly; the others hold still. Takes over a rig that holds itself."""
    from .connect import connect
    from .errors import unknown
    from .mapping import joint_bounds
    from .mirror import Session
    from .mirror.record import make_report

    loaded = load_rig(rig)
    driver, note = connect(loaded, port=port)
    try:
        session = Session(loaded, driver, stop=_stop_word(stop), take_over=True)
        mapping = session.mapping
        if joint not in mapping.joints:
            raise HardwareError(unknown("joint", joint, mapping.joints, where=loaded.name))
        j = mapping.joints.index(joint)
        step = by * 1e-3 if j in mapping.curves else np.radians(by)
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

        with _terminable():
            outcome = session.run(first, lambda t: session.goal, 0.3)
        report = make_report(outcome, loaded, driver, mapping, notes=(note,))
    finally:
        driver.close()
    if report.status == "done":
        text = (
            f"{report.measured[-1, j]:.4f} m"
            if j in mapping.curves
            else f"{np.degrees(report.measured[-1, j]):.2f} deg"
        )
        console.print(f"{joint} is at {text}; the rig {report.stop}")
    else:
        console.print(escape(str(report)), highlight=False)
    _finish(report)


@app.command("set-id", epilog="Example: pantograph servo set-id /dev/ttyUSB0 1 7")
def set_id(
    port: Annotated[str, typer.Argument(help="Serial device.")],
    old: Annotated[int, typer.Argument(help="Present ID.")],
    new: Annotated[int, typer.Argument(help="New ID, 0 to 252.")],
    baud: BaudOption = 1_000_000,
) -> None:
    """Change the ID of a servo."""
    from . import service

    with _driver(port, baud) as driver:
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
    from . import service

    with _driver(port, baud) as driver:
        service.set_baud(driver, id, new)
    console.print(f"servo {id} speaks at {new:,} bit/s now")


@app.command(epilog="Example: pantograph servo stop wx250s --limp")
def stop(
    rig: RigFile,
    port: PortOption = None,
    limp: Annotated[bool, typer.Option("--limp", help="Torque off; a raised arm drops.")] = False,
) -> None:
    """Stop a rig: hold where it is, or let it go. This is a word over a cable, no power cut."""
    from .connect import connect
    from .mirror.contract import freeze, release

    loaded = load_rig(rig)
    driver, _ = connect(loaded, port=port)
    try:
        known = [f.id for f in driver.broadcast_ping().values()]
        for servo in loaded.servos:
            if servo.id not in known:  # stop it all the same, by the model that the file says
                from .registers import control_table

                driver.tables[servo.id] = control_table(servo.model)
        failed = release(driver, loaded) if limp else freeze(driver, loaded, at_present=True)
    finally:
        driver.close()
    for text in failed:
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
    from ..models import load_model
    from ..models.naming import joint_names
    from . import calibrate as by_hand

    if out.exists():
        raise HardwareError(f"{out} exists; choose another name, or remove it first")
    robot = load_model(model)
    scalar = [n for i, n in enumerate(joint_names(robot)) if int(robot.jnt_type[i]) in (2, 3)]
    with _driver(port, baud) as driver:
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


@app.command(epilog="Example: pantograph servo simulate wx250s --link /tmp/wx250s")
def simulate(
    what: Annotated[list[str], typer.Argument(help="A rig, or models of servos with IDs 1, 2, ...")],
    link: Annotated[Path | None, typer.Option(help="Name for the serial port: a symbolic link.")] = None,
    baud: Annotated[int, typer.Option(help="Bit rate of servos given by model.")] = 1_000_000,
    loss: Annotated[float, typer.Option(help="Part of packets that is lost.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Of the losses.")] = 0,
    physics: Annotated[
        bool, typer.Option("--physics", help="Servos of a rig carry its model: gravity, inertia, contacts.")
    ] = False,
) -> None:
    """Virtual servos on a pseudo-terminal, which any program opens as a serial port. Ctrl-C ends it."""
    from .virtual import FaultPlan, PtyServer, VirtualBus, VirtualServo, WireFault
    from .virtual_rig import virtual_bus

    faults = FaultPlan(wire=(WireFault("lost", loss),) if loss else (), seed=seed)
    if len(what) == 1 and _is_rig(what[0]):
        rig = load_rig(what[0])
        bus = virtual_bus(rig, model=rig.load_model() if physics else None, faults=faults)
    elif physics:
        raise HardwareError("--physics needs a rig whose file names its model, not models of servos")
    else:
        servos = [VirtualServo(m, i, baud=baud) for i, m in enumerate(what, start=1)]
        bus = VirtualBus(servos, faults=faults)
    with _terminable():
        server = PtyServer(bus, link=link)
        servos_text = ", ".join(f"{s.id} {s.table.model}" for s in bus.servos)
        print(f"port {server.port}: {servos_text}", flush=True)
        try:
            server.run()
        except KeyboardInterrupt:
            server.close()


def _is_rig(name: str) -> bool:
    try:
        find_rig(name)
    except HardwareError:
        if name.endswith(".toml"):
            raise
        return False
    return True


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
    from ..sim.recording import load

    report = play_recording(
        load(recording), rig, slow=slow, stop=stop, port=port, take_over=take_over, paced=paced
    )
    if out is not None and report.recording is not None:
        console.print(f"the rig's recording: {report.recording.save(out)}")
    _finish(report)


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
    from .mirror.teleop import teleoperate

    with _terminable():
        report = teleoperate(
            leader,
            follower,
            duration=seconds,
            stop=_stop_word(stop),
            leader_port=leader_port,
            follower_port=follower_port,
            paced=paced,
        )
    if out is not None and report.recording is not None:
        console.print(f"the leader's recording: {report.recording.save(out)}")
    if report.follower is not None:
        console.print(escape(str(report.follower)), highlight=False)
        _finish(report.follower)
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
    from .mirror import mirror_live, mirror_recording

    screen = to or console
    loaded = load_rig(rig) if isinstance(rig, str | Path) else rig
    options: dict[str, Any] = {
        "stop": _stop_word(stop),
        "port": port,
        "take_over": take_over,
        "paced": paced,
        "on_phase": lambda phase: screen.print(f"[dim]{phase}"),
    }
    length = getattr(recording, "duration", None)
    if length is None:
        length = float(recording.t[-1] - recording.t[0]) if hasattr(recording, "t") else None
    with _terminable(), _bar(f"mirroring to {loaded.name}", length, to=screen) as advance:
        if live:
            report = mirror_live(recording, loaded, progress=advance, **options)
        else:
            report = mirror_recording(recording, loaded, slow=slow, progress=advance, **options)
    if report.verdict is not None and not report.verdict.ok:
        screen.print(escape(str(report.verdict)), highlight=False)
    screen.print(escape(str(report)), highlight=False)
    return report


def _finish(report: Any) -> None:
    """Exit status of a report: 0 done, 1 fault, 130 interrupted."""
    if report.status != "done":
        raise typer.Exit(130 if report.status == "interrupted" else 1)


def _stop_word(word: str) -> Stop:
    words: dict[str, Stop] = {"hold": "hold", "park": "park", "limp": "limp"}
    if word in words:
        return words[word]
    raise HardwareError(f"no stop {word!r}; there are: hold, park, limp")


@contextmanager
def _driver(port: str, baud: int) -> Iterator[Any]:
    """Driver of a bare serial port."""
    from .connect import REAL_MARGIN, TERMINAL_MARGIN
    from .driver import Driver
    from .ports import latency_of, open_port

    if port == VIRTUAL:
        raise HardwareError(
            "virtual servos in memory belong to a rig; 'pantograph servo simulate' gives a port"
        )
    latency = latency_of(port)
    opened, clock = open_port(port, baud)
    margin = TERMINAL_MARGIN if Path(port).resolve().parent.name == "pts" else REAL_MARGIN
    driver = Driver(opened, clock, latency=latency.seconds, margin=margin)
    console.print(f"[dim]{escape(latency.note)}")
    try:
        yield driver
    finally:
        driver.close()


@contextmanager
def _bar(what: str, total: float | None, *, to: Console | None = None) -> Iterator[Any]:
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=to or console, transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)


@contextmanager
def _terminable() -> Iterator[None]:
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
