"""The one small family of errors that Pantograph raises on purpose."""

from collections.abc import Iterable
from difflib import get_close_matches


class PantographError(Exception):
    """Base of every error raised on purpose: its message says what is wrong, where, what would be right."""


class ModelError(PantographError):
    """A model file is missing or broken, or a name in it does not exist."""


class ModelWarning(UserWarning):
    """A model was loaded, but not exactly as its file has it: the message says what was changed."""


def unknown(kind: str, name: str, known: Iterable[str], *, where: str = "this model") -> str:
    """Message for a name that does not exist: names it, offers the nearest, lists what exists."""
    names = sorted(known)
    close = get_close_matches(name, names, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    listing = ", ".join(names) if names else "none"
    return f"no {kind} {name!r}{hint}; {where} has: {listing}"
