"""Where bytes and time come from: a serial port, or virtual servos in memory, under one face.

A port has the methods that the packet handler of dynamixel_sdk calls. `SerialPort` replaces the SDK's own
PortHandler, which reads in a busy loop, measures timeouts with the wall clock and lets two programs open one
device.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from .errors import BusError

_GONE: tuple[type[Exception], ...] = (OSError, ValueError)  # what calls on a device that has gone raise
with suppress(ImportError):  # not on every system
    import termios

    _GONE = (*_GONE, termios.error)  # is no OSError

if TYPE_CHECKING:
    from .virtual import VirtualBus

BITS_PER_BYTE = 10  # 8 data bits, start, stop
WANTED_LATENCY = 1e-3  # s
FTDI_DEFAULT = 16e-3  # s
_READ_WAIT = 2e-3  # s that a read blocks for its bytes before the timeout is looked at again
_SPIN = 2e-4  # s before a deadline during which sleeping is too coarse


class Clock(Protocol):
    """Time of a bus [s], and waiting on it."""

    def now(self) -> float:
        """Seconds since some fixed moment."""
        ...

    def sleep_until(self, t: float) -> None:
        """Return at time `t` [s]; at once when it has passed."""
        ...


class RealClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """See Clock."""
        return time.perf_counter()

    def sleep_until(self, t: float) -> None:
        """Sleep, then spin for the last fraction of a millisecond, which a sleep would miss."""
        rest = t - time.perf_counter()
        if rest > _SPIN:
            time.sleep(rest - _SPIN)
        while time.perf_counter() < t:
            pass


class VirtualClock:
    """The clock of virtual servos in memory; with `paced`, waits last as long as on the wall."""

    def __init__(self, bus: VirtualBus, *, paced: bool = False) -> None:
        self.bus = bus
        self._begin = time.perf_counter() - bus.time if paced else None

    def now(self) -> float:
        """See Clock."""
        return self.bus.time

    def sleep_until(self, t: float) -> None:
        """See Clock."""
        if self._begin is not None:
            time.sleep(max(0.0, self._begin + t - time.perf_counter()))
        self.bus.advance_to(t)


@dataclass(frozen=True)
class Latency:
    """Latency timer of a USB adapter: how long it keeps received bytes back [s], and what that means."""

    seconds: float
    note: str


class SerialPort:
    """A serial device behind pyserial, opened for this program alone.

    Raises:
        BusError: the device is missing, busy, or goes away; the message says which.
    """

    def __init__(self, device: str, baudrate: int = 1_000_000) -> None:
        self.port_name = device
        self.baudrate = baudrate
        self.is_open = False
        self.is_using = False
        self.packet_start_time = 0.0
        self.packet_timeout = 0.0
        self._serial: Any = None

    def openPort(self) -> bool:
        """Open at the present bit rate."""
        import serial

        self.closePort()
        try:
            self._serial = serial.Serial(
                self.port_name, self.baudrate, timeout=_READ_WAIT, write_timeout=1.0, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as e:
            raise BusError(_why_not_open(self.port_name, e)) from None
        self.is_open = True
        self.is_using = False
        return True

    def closePort(self) -> None:
        """Close, if open."""
        if self._serial is not None:
            self._serial.close()
        self.is_open = False

    def setBaudRate(self, baudrate: int) -> bool:
        """Set the bit rate [bit/s]; False for one that the device refuses."""
        self.baudrate = baudrate
        if not self.is_open:
            return self.openPort()
        try:
            self._serial.baudrate = baudrate
        except _GONE:
            return False
        return True

    def getBaudRate(self) -> int:
        """Bit rate [bit/s]."""
        return self.baudrate

    def clearPort(self) -> None:
        """Forget bytes that have arrived."""
        self._guard(self._serial.reset_input_buffer)

    def readPort(self, length: int) -> bytes:
        """At most `length` bytes; waits a little for them, instead of a busy loop."""
        return bytes(self._guard(self._serial.read, length))

    def writePort(self, packet: bytes | list[int]) -> int:
        """Send bytes."""
        return int(self._guard(self._serial.write, bytes(packet)) or 0)

    def setPacketTimeoutMillis(self, msec: float) -> None:
        """Start a timeout [ms]."""
        self.packet_start_time, self.packet_timeout = time.perf_counter(), msec

    def isPacketTimeout(self) -> bool:
        """Whether the timeout has passed; then it is cleared."""
        if (time.perf_counter() - self.packet_start_time) * 1000.0 > self.packet_timeout:
            self.packet_timeout = 0.0
            return True
        return False

    def _guard(self, call: Any, *args: Any) -> Any:
        import serial

        try:
            return call(*args)
        except (serial.SerialException, TypeError, AttributeError, *_GONE) as e:
            raise BusError(
                f"port {self.port_name} is gone ({e}): is the cable in, the adapter powered?"
            ) from None


def open_port(
    name: str, baud: int, *, bus: VirtualBus | None = None, paced: bool = False
) -> tuple[Any, Clock]:
    """Open a port and its clock; with `bus`, virtual servos in memory take the place of the device `name`."""
    if bus is not None:
        from .virtual import MemoryPort

        memory = MemoryPort(bus, baud, port_name=name)
        if not memory.openPort():
            raise BusError(f"bit rate {baud:,} is none that dynamixel_sdk knows")
        return memory, VirtualClock(bus, paced=paced)
    port = SerialPort(name, baud)
    port.openPort()
    return port, RealClock()


def serial_devices() -> list[str]:
    """Serial devices of this machine that could be a servo adapter."""
    from serial.tools import list_ports

    return sorted(p.device for p in list_ports.comports())


def latency_of(device: str) -> Latency:
    """Set the adapter's latency timer to 1 ms if this user may; else say what it costs."""
    real = Path(device).resolve().name
    file = Path("/sys/bus/usb-serial/devices") / real / "latency_timer"
    if device.startswith("/dev/pts/") or real.isdigit():
        return Latency(0.0, "a pseudo-terminal has no latency timer")
    if not file.exists():
        return Latency(
            FTDI_DEFAULT if real.startswith("ttyUSB") else WANTED_LATENCY,
            f"{device}: the latency timer cannot be seen here; if it is an FTDI adapter, set it to 1 ms",
        )
    now = int(file.read_text()) * 1e-3
    if now <= WANTED_LATENCY:
        return Latency(now, f"latency timer {now * 1e3:.0f} ms")
    try:
        file.write_text("1")
        return Latency(WANTED_LATENCY, f"latency timer set from {now * 1e3:.0f} to 1 ms")
    except OSError:
        return Latency(
            now,
            f"latency timer is {now * 1e3:.0f} ms, which caps a loop near {1 / now:.0f} Hz; "
            f"set it: echo 1 | sudo tee {file}",
        )


def _why_not_open(device: str, error: Exception) -> str:
    text = str(error)
    if "could not exclusively lock" in text or "Resource temporarily unavailable" in text:
        return f"port {device} is in use by another program; one program at a time may talk to servos"
    if "Permission denied" in text:
        return f"no permission for {device}: add yourself to its group (often dialout), then log in again"
    here = ", ".join(serial_devices()) or "none"
    return f"cannot open port {device}: {text}; serial devices here: {here}"
