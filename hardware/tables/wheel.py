"""Where the manual and the `.model` files of the dynamixel-sdk 4.1.0 wheel disagree, and what was decided.

The rows of this package follow the manual except where an entry here says otherwise; a test compares every
row with the wheel and fails on a disagreement that is not listed, and on an entry that no longer holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Disagreement:
    """One disagreement.

    Args:
        models: Beginnings of the model names that it concerns.
        registers: Names of the registers.
        field: Which field of the row; `row` when the wheel has none.
        manual, wheel: What each says.
        decided: Whose value the row carries.
        reason: Why.
    """

    models: tuple[str, ...]
    registers: tuple[str, ...]
    field: Literal["address", "unit", "row"]
    manual: str
    wheel: str
    decided: Literal["manual", "wheel"]
    reason: str

    def concerns(self, model: str, register: str, field: str) -> bool:
        """Whether this entry is about a field of a row."""
        return field == self.field and register in self.registers and model.startswith(self.models)


SMALL = ("xl330", "xc330")
CURRENT = ("goal_current", "present_current")

DISAGREEMENTS: tuple[Disagreement, ...] = (
    Disagreement(
        ("x", "mx"),
        ("goal_velocity", "present_velocity"),
        "unit",
        "0.229 rev/min",
        "0.0239691227 rad/s",
        "wheel",
        "the manual rounds to three digits; the wheel's value, 0.22889 rev/min, rounds to it and has more",
    ),
    Disagreement(
        ("xm", "xh430-w"),
        CURRENT,
        "unit",
        "2.69 mA",
        "1.0 raw",
        "manual",
        "the wheel gives no unit",
    ),
    Disagreement(("xh430-v",), CURRENT, "unit", "1.34 mA", "1.0 raw", "manual", "the wheel gives no unit"),
    Disagreement(
        ("mx-64", "mx-106"), CURRENT, "unit", "3.36 mA", "1.0 raw", "manual", "the wheel gives no unit"
    ),
    Disagreement(
        ("xl330", "xc330-m"), CURRENT, "unit", "1 mA", "1.0 raw", "manual", "the wheel gives no unit"
    ),
    Disagreement(
        ("xc330-t181",),
        CURRENT,
        "unit",
        "1 mA",
        "0.0006709470296015791 N/m",
        "manual",
        "the register holds a current; the wheel multiplies by a torque constant and names a stiffness",
    ),
    Disagreement(
        ("xc330-t288",),
        CURRENT,
        "unit",
        "1 mA",
        "0.0009674796739867748 N/m",
        "manual",
        "the register holds a current; the wheel multiplies by a torque constant and names a stiffness",
    ),
    Disagreement(
        SMALL,
        ("indirect_data_1",),
        "address",
        "208",
        "224",
        "manual",
        "224 lies behind the 20 indirect addresses of these models; the wheel's own *_fw52 files say 208",
    ),
    Disagreement(
        SMALL,
        ("indirect_data_7",),
        "address",
        "214",
        "230",
        "manual",
        "follows indirect_data_1; the wheel calls it Indirect Data Read",
    ),
    Disagreement(
        (*SMALL, "xl430"),
        ("startup_configuration", "backup_ready"),
        "row",
        "present",
        "absent",
        "manual",
        "newer firmware; the wheel's files predate it",
    ),
)
