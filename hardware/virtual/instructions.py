"""From an instruction packet to what one servo does and replies.

Source: https://emanual.robotis.com/docs/en/dxl/protocol2/, instruction details.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..packets import BROADCAST, Instruction, Packet, StatusError, status

if TYPE_CHECKING:
    from .servo import VirtualServo

CLEAR_TURNS = b"\x01\x44\x58\x4c\x22"
STORE, RESTORE = b"\x01CTRL", b"\x02CTRL"
KEPT: dict[bytes, tuple[str, ...]] = {b"\xff": (), b"\x01": ("id",), b"\x02": ("id", "baud_rate")}


def execute(servo: VirtualServo, packet: Packet) -> Packet | None:
    """Carry out an instruction; the reply, or None when the servo is to be silent.

    Silent are broadcasts but for ping, the shadow ID, and what the status return level excludes.
    """
    own = servo.id
    shadow = packet.id not in (own, BROADCAST)
    level = servo.memory.get("status_return_level")
    error, data = _do(servo, packet, shadow)
    if packet.instruction == Instruction.PING:
        return None if shadow else status(own, servo.error_byte(error), data)
    wanted = level == 2 or (level == 1 and packet.instruction == Instruction.READ)
    return status(own, servo.error_byte(error), data) if wanted and packet.id == own else None


def _do(servo: VirtualServo, packet: Packet, shadow: bool) -> tuple[StatusError, bytes]:
    params = packet.params
    match packet.instruction:
        case Instruction.PING:
            return StatusError.NONE, bytes(servo.memory.bytes[0:2]) + bytes((servo.firmware,))
        case Instruction.READ if len(params) == 4:
            return servo.read(_word(params, 0), _word(params, 2))
        case Instruction.WRITE if len(params) >= 2:
            return servo.write(_word(params, 0), params[2:], shadow=shadow), b""
        case Instruction.REG_WRITE if len(params) >= 2:
            return servo.register(_word(params, 0), params[2:], shadow=shadow), b""
        case Instruction.ACTION:
            return servo.act(), b""
        case Instruction.REBOOT:
            servo.reboot()
            return StatusError.NONE, b""
        case Instruction.CLEAR:
            return servo.clear_turns() if params == CLEAR_TURNS else StatusError.DATA_RANGE, b""
        case Instruction.FACTORY_RESET:
            return _factory_reset(servo, packet), b""
        case Instruction.BACKUP if params == STORE:
            return servo.store(), b""
        case Instruction.BACKUP if params == RESTORE:
            return servo.restore(), b""
        case Instruction.BACKUP:
            return StatusError.DATA_RANGE, b""
    return StatusError.INSTRUCTION, b""


def _factory_reset(servo: VirtualServo, packet: Packet) -> StatusError:
    """Reset; one of everything, IDs too, is refused as a broadcast (manual: firmware 42 and later)."""
    keep = KEPT.get(packet.params)
    if keep is None or (not keep and packet.id == BROADCAST):
        return StatusError.DATA_RANGE
    return servo.factory_reset(keep)


def _word(data: bytes, place: int) -> int:
    return data[place] | data[place + 1] << 8
