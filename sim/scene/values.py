"""Values of a scene: numbers, vectors, switches; a mistake in one says what belongs there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError, PydanticKnownError


def at(*where: str | int, message: str) -> ValidationError:
    """A mistake at a word of an item, for its validators to raise."""
    error = PydanticCustomError("said", "{message}", {"message": message})
    return ValidationError.from_exception_data("item", [InitErrorDetails(type=error, loc=where, input=None)])


def _number(value: Any) -> Any:
    """Texts and switches are no numbers, though pydantic could read them as such."""
    if isinstance(value, bool | str):
        raise PydanticCustomError("kind", "must be {kind}", {"kind": "a number"})
    if isinstance(value, float) and not np.isfinite(value):
        raise PydanticKnownError("finite_number")
    return value


def _row(*counts: int, of: str = "numbers") -> Callable[[Any], Any]:
    wanted = f"{' or '.join(str(n) for n in counts)} {of}"

    def check(value: Any) -> Any:
        if not isinstance(value, list | tuple):
            raise PydanticCustomError("kind", "must be {kind}", {"kind": f"a list of {wanted}"})
        if len(value) not in counts:
            raise PydanticCustomError("count", "needs {wanted}, got {n}", {"wanted": wanted, "n": len(value)})
        return value

    return check


def plain(value: Any) -> Any:
    """NumPy's numbers and arrays as Python's own."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return type(value)(plain(v) for v in value)
    return value


Finite = Annotated[float, BeforeValidator(_number), Field(allow_inf_nan=False)]
Positive = Annotated[float, BeforeValidator(_number), Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, BeforeValidator(_number), Field(ge=0, allow_inf_nan=False)]
Switch = Annotated[bool, Field(strict=True)]
Vector = Annotated[tuple[Finite, Finite, Finite], BeforeValidator(_row(3))]
Quaternion = Annotated[tuple[Finite, Finite, Finite, Finite], BeforeValidator(_row(4))]
Colour = Annotated[
    tuple[Finite, Finite, Finite] | tuple[Finite, Finite, Finite, Finite], BeforeValidator(_row(3, 4))
]
Pair = Annotated[tuple[str, str], BeforeValidator(_row(2, of="names"))]
Span = Annotated[tuple[Finite, Finite], BeforeValidator(_row(2))]
Row = Finite | list[Finite]
