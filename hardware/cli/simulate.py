"""The command that offers virtual servos on a serial port."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import HardwareError
from ..rig import find_rig, load_rig
from .common import app, terminable


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
    from ..virtual import FaultPlan, PtyServer, VirtualBus, VirtualServo, WireFault
    from ..virtual_rig import virtual_bus

    faults = FaultPlan(wire=(WireFault("lost", loss),) if loss else (), seed=seed)
    if len(what) == 1 and _is_rig(what[0]):
        rig = load_rig(what[0])
        bus = virtual_bus(rig, model=rig.load_model() if physics else None, faults=faults)
    elif physics:
        raise HardwareError("--physics needs a rig whose file names its model, not models of servos")
    else:
        servos = [VirtualServo(m, i, baud=baud) for i, m in enumerate(what, start=1)]
        bus = VirtualBus(servos, faults=faults)
    with terminable():
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
