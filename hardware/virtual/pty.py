"""A pseudo-terminal that any program opens as a serial port, with virtual servos behind it, in real time.

What dynamixel_sdk's PortHandler needs of it: opening at any rate of its list (the rate is read back from the
terminal's settings, so that a wrong one meets silence), FIONREAD, TCFLUSH and raw bytes. RTS, CTS and the
low-latency ioctl do not exist on a pseudo-terminal. Wire time is kept in the ledger, never slept.
"""

from __future__ import annotations

import fcntl
import os
import select
import sys
import termios
import threading
import time
import tty
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from ..errors import BusError
from .bus import VirtualBus

TICK = 2e-3  # s between looks at the clock while no byte comes

_TCGETS2 = 0x802C542A  # asm-generic/ioctls.h: struct termios2, output speed in its last four bytes
_RATES = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
}


class PtyServer:
    """Serves a bus on a pseudo-terminal; use `serve`, or `run` in a process of its own.

    Args:
        bus: The servos; its clock becomes real time.
        link: Symbolic link to make to the terminal, so that its name is known and survives a pulled cable.

    Attributes:
        port: Name to open: the link, or the terminal.
        lock: Held while bytes are handled; take it to look at the bus from another thread.
    """

    def __init__(self, bus: VirtualBus, *, link: str | Path | None = None) -> None:
        self.bus = bus
        self.lock = threading.RLock()
        self._link = Path(link) if link is not None else None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._master = self._slave = -1
        self._held: list[tuple[float, bytes]] = []
        bus.paced = False
        self._begin = time.monotonic() - bus.time
        self._plug()

    @property
    def port(self) -> str:
        """Name to open as a serial port."""
        return str(self._link) if self._link is not None else self._name

    def start(self) -> PtyServer:
        """Serve in a thread."""
        self._thread = threading.Thread(target=self.run, name=f"virtual bus {self.port}", daemon=True)
        self._thread.start()
        return self

    def run(self) -> None:
        """Serve until `close` is called, from another thread or a signal handler."""
        try:
            while not self._stop.is_set():
                self._turn()
        finally:
            with self.lock:
                self._unplug()

    def unplug(self) -> None:
        """Pull the cable: the program at the other end gets an error (pyserial: SerialException)."""
        with self.lock:
            self._unplug()

    def plug(self) -> None:
        """Put the cable back: a new terminal under the same link."""
        with self.lock:
            if self._master < 0:
                self._plug()

    def close(self) -> None:
        """Stop serving and remove the terminal."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        else:
            self.unplug()

    def __enter__(self) -> PtyServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _plug(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._name = os.ttyname(self._slave)
        if self._link is not None:
            if self._link.exists() and not self._link.is_symlink():
                raise BusError(f"{self._link} exists and is no link; choose another name for the serial port")
            try:
                self._link.unlink(missing_ok=True)
                self._link.symlink_to(self._name)
            except OSError as error:
                raise BusError(f"cannot make the link {self._link}: {error.strerror}") from error

    def _unplug(self) -> None:
        if self._master >= 0:
            os.close(self._slave)
            os.close(self._master)
            self._master = self._slave = -1
            if self._link is not None:
                self._link.unlink(missing_ok=True)

    def _turn(self) -> None:
        """Wait for bytes or the next tick, then bring the bus up to date."""
        if self._master >= 0:
            select.select([self._master], [], [], TICK)
        else:
            self._stop.wait(TICK)
        with self.lock:
            now = time.monotonic() - self._begin
            self.bus.advance_to(now)
            self._cable(now)
            if self._master < 0:
                return
            if data := self._read():
                self.bus.send(data, self._baud())
            for delivery in self.bus.deliveries():
                self._held.append((now + delivery.held, delivery.data))
            due = b"".join(data for at, data in self._held if at <= now)
            self._held = [(at, data) for at, data in self._held if at > now]
            if due:
                self._write(due)

    def _cable(self, now: float) -> None:
        """Follow the cable pulls of the fault plan."""
        if self.bus.faults.cable:
            out = self.bus.faults.unplugged(now)
            if out and self._master >= 0:
                self._unplug()
            elif not out and self._master < 0:
                self._plug()

    def _baud(self) -> int:
        """Rate that the other side has set [bit/s]; on Linux custom rates too."""
        if sys.platform == "linux":
            state = fcntl.ioctl(self._slave, _TCGETS2, bytes(44))
            return int.from_bytes(state[40:44], sys.byteorder) or 1
        return _RATES.get(termios.tcgetattr(self._slave)[5], 0) or 1

    def _read(self) -> bytes:
        try:
            return os.read(self._master, 4096)
        except BlockingIOError:
            return b""

    def _write(self, data: bytes) -> None:
        with suppress(BlockingIOError):  # nobody reads: a serial buffer overflows in the same way
            os.write(self._master, data)


def serve(bus: VirtualBus, *, link: str | Path | None = None) -> PtyServer:
    """Serve a bus on a pseudo-terminal in a thread; a context manager whose `port` any program can open.

    For a process of its own, build `PtyServer(bus)` and call `run`.
    """
    return PtyServer(bus, link=link).start()
