"""In-memory serial port with a virtual clock, under the unmodified packet classes of dynamixel_sdk."""

from __future__ import annotations

from ..errors import BusError
from .bus import VirtualBus

# What dynamixel_sdk 4.1.0 PortHandler accepts and assumes.
SDK_BAUD_RATES = (
    9_600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 500_000, 576_000, 921_600, 1_000_000, 1_152_000,
    2_000_000, 2_500_000, 3_000_000, 3_500_000, 4_000_000,
)  # fmt: skip
SDK_LATENCY_MS = 16
IDLE_POLL = 1e-5  # s of virtual time that an empty read takes while nothing is under way and no timeout runs


class MemoryPort:
    """Stands in for `dynamixel_sdk.PortHandler`: same methods and attributes, no device, no sleeping.

    Reading while no byte has arrived moves the bus clock to the next byte, or past the SDK's timeout,
    whichever comes first; so a timeout of 35 ms costs microseconds of real time and a run is the same every
    time.

    Args:
        bus: The servos.
        baudrate: Bit rate [bit/s].

    Raises:
        BusError: on read or write while the cable is pulled (as pyserial's SerialException) or the port is
            closed.
    """

    def __init__(self, bus: VirtualBus, baudrate: int = 1_000_000, *, port_name: str = "memory") -> None:
        self.bus = bus
        self.baudrate = baudrate
        self.port_name = port_name
        self.is_open = False
        self.is_using = False
        self.packet_start_time = 0.0
        self.packet_timeout = 0.0
        self.tx_time_per_byte = 10_000.0 / baudrate
        self._received = bytearray()

    # Names and behaviour of dynamixel_sdk.PortHandler.

    def openPort(self) -> bool:
        """Open at the present bit rate."""
        return self.setBaudRate(self.baudrate)

    def closePort(self) -> None:
        """Close; reading and writing raise until it is opened again."""
        self.is_open = False

    def clearPort(self) -> None:
        """Forget bytes that have arrived; those still on the wire will come."""
        self._pull()
        self._received.clear()

    def setPortName(self, port_name: str) -> None:
        """Name for messages."""
        self.port_name = port_name

    def getPortName(self) -> str:
        """Name for messages."""
        return self.port_name

    def setBaudRate(self, baudrate: int) -> bool:
        """Set the bit rate [bit/s] and open; False for one that the SDK does not know."""
        if baudrate not in SDK_BAUD_RATES:
            return False
        self.baudrate = baudrate
        self.tx_time_per_byte = 10_000.0 / baudrate
        self.is_open = True
        self._received.clear()
        return True

    def getBaudRate(self) -> int:
        """Bit rate [bit/s]."""
        return self.baudrate

    def getBytesAvailable(self) -> int:
        """Bytes that have arrived."""
        self._pull()
        return len(self._received)

    def readPort(self, length: int) -> bytes:
        """At most `length` bytes; when none has arrived, the clock moves on."""
        self._check()
        self._pull()
        if not self._received and length > 0:
            self._wait()
            self._pull()
        data = bytes(self._received[:length])
        del self._received[:length]
        return data

    def writePort(self, packet: bytes | list[int]) -> int:
        """Send bytes; the clock advances by their time on the wire."""
        self._check()
        data = bytes(packet)
        self.bus.send(data, self.baudrate)
        return len(data)

    def setPacketTimeout(self, packet_length: int) -> None:
        """As the SDK: time on the wire of a packet, plus twice the latency timer, plus 2 ms."""
        self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + SDK_LATENCY_MS * 2.0 + 2.0)

    def setPacketTimeoutMillis(self, msec: float) -> None:
        """Start a timeout [ms]."""
        self.packet_start_time = self.getCurrentTime()
        self.packet_timeout = msec

    def isPacketTimeout(self) -> bool:
        """Whether the timeout has passed; then it is cleared."""
        if self.getTimeSinceStart() > self.packet_timeout:
            self.packet_timeout = 0.0
            return True
        return False

    def getCurrentTime(self) -> float:
        """Virtual time [ms]."""
        return self.bus.time * 1000.0

    def getTimeSinceStart(self) -> float:
        """Since the timeout was started [ms]."""
        return self.getCurrentTime() - self.packet_start_time

    # Virtual time.

    def _check(self) -> None:
        if not self.is_open:
            raise BusError(f"port {self.port_name!r} is closed; call openPort first")
        if self.bus.faults.unplugged(self.bus.time):
            raise BusError(f"port {self.port_name!r} is gone: the cable was pulled")

    def _pull(self) -> None:
        self._received += self.bus.receive()

    def _wait(self) -> None:
        deadline = (self.packet_start_time + self.packet_timeout) / 1000.0
        arrival = self.bus.next_delivery
        if self.packet_timeout <= 0:
            step = IDLE_POLL if arrival is None else max(arrival - self.bus.time, 0.0)
            self.bus.advance(step)
        elif arrival is not None and arrival <= deadline:
            self.bus.advance_to(arrival)
        else:
            self.bus.advance_to(deadline + 1e-6)
