"""Errors of the hardware side; one family with those of the models."""

from ..models.errors import PantographError, unknown

__all__ = ["BusError", "HardwareError", "PantographError", "RegisterError", "SourceFault", "unknown"]


class HardwareError(PantographError):
    """A servo, a rig or its description cannot do what is asked."""


class RegisterError(HardwareError):
    """A register does not exist in a servo's control table, or a value does not fit it."""


class BusError(HardwareError):
    """The serial bus, real or virtual, could not carry a packet."""


class SourceFault(HardwareError):
    """What a rig follows, a simulation or a leader, gives no goals any more; the servos are sound."""
