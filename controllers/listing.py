"""What laws there are, and the words that scenes can tell them: from their signatures and docstrings."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from .ilc import learn
from .reality import Loop
from .trial import ILC, ILC_WORDS


class Word(NamedTuple):
    """A parameter, its default, and its unit as the docstring gives it, both in words."""

    name: str
    default: str
    unit: str


class Entry(NamedTuple):
    """A law, what it does in a line, its docstring, and its words."""

    name: str
    says: str
    about: str
    words: tuple[Word, ...]


def laws() -> Iterator[Entry]:
    """All laws, the one that learns, and last what sensors and drives do around any of them."""
    from ..sim.compose import LAWS

    for name, find in LAWS.items():
        yield _entry(name, find())
    learns = _entry(ILC, learn)
    of = Word("of", "the scene's law", "")
    yield learns._replace(words=(of, *(word for word in learns.words if word.name in ILC_WORDS)))
    yield _entry("sensors and drives", Loop)


def _entry(name: str, made: Callable[..., Any]) -> Entry:
    module, about = inspect.getmodule(made), _plain(inspect.getdoc(made) or "")
    says = _plain((module.__doc__ or "") if module else "").partition("\n")[0]
    parameters = inspect.signature(made).parameters.values()
    own = [p for p in parameters if p.kind == p.KEYWORD_ONLY]
    return Entry(
        name, says, about, tuple(Word(p.name, _default(p.default), _unit(p.name, about)) for p in own)
    )


def _plain(text: str) -> str:
    """A docstring without marks of roles and literals, and without its errors, a paragraph a line."""
    text = re.sub(r":\w+:`~?([\w.]+)`", lambda found: found[1].rpartition(".")[2], text)
    text = re.sub(r"(?<!\n)\n\s*(?!\n|- )", " ", text.replace("``", "'"))
    return re.sub(r"\s*Raises [^\n]*", "", text)


def _default(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, int | float) else repr(value)


def _unit(word: str, about: str) -> str:
    """The unit in brackets after a word."""
    found = re.search(rf"'{word}'(?:, '\w+'| and '\w+')*\s+\[([^\]]+)\]", about)
    return found[1] if found else ""
