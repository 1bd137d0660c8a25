"""Variants to compare: laws, each with its words of the scene and of a sweep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from ...sim.compose import check_law, known_words
from ...sim.errors import PantographError
from ...sim.scene.schema import Scene
from ..gains import positive
from ..trial import ILC, ILC_WORDS

PERIOD = "period"  # no parameter of a law: the controller's own


@dataclass(frozen=True)
class Variant:
    """A law with its parameters, and what it is called in tables."""

    law: str
    words: Mapping[str, Any]
    name: str

    @property
    def own(self) -> dict[str, Any]:
        """Parameters of the law itself."""
        return {word: value for word, value in self.words.items() if word != PERIOD}


def variants(scene: Scene, laws: Sequence[str], sweep: Mapping[str, Sequence[Any]]) -> list[Variant]:
    """Each law with each combination of those words of ``sweep`` that it has, and the scene's own words.

    A law gets every word of the scene's controller that it knows: words mean the same in all of them. Raises
    SceneError for laws and words that do not exist, PantographError for those named twice or without values.
    """
    _check_lists(laws, sweep)
    base = scene.controller.law if scene.controller else "pd"
    for word in sweep:
        if word != PERIOD and not any(word in _words_of(law, base, sweep) for law in laws):
            _check(laws[0], base, {word: None})
    out: dict[str, Variant] = {}
    for law in laws:
        able = (PERIOD, *_words_of(law, base, sweep))
        known = {word: values for word, values in sweep.items() if word in able}
        for values in product(*known.values()):
            chosen = dict(zip(known, values, strict=True))
            of = str(chosen.get("of", base))
            words = told(scene, of if law == ILC else law) | ({"of": of} if law == ILC else {})
            label = " ".join([law, *(f"{k}={shown(v)}" for k, v in chosen.items())])
            out[label] = Variant(law, words | chosen, label)
            _check(law, base, out[label].own)
    return list(out.values())


def shown(value: Any) -> str:
    """A value as one would type it: whole numbers as such, several by joint."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k}={shown(v)}" for k, v in value.items()) + "}"
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return str(int(value))
    return str(value)


def _check_lists(laws: Sequence[str], sweep: Mapping[str, Sequence[Any]]) -> None:
    if isinstance(laws, str) or not laws:
        raise PantographError(f"laws to compare are a list of names, as ['pd', 'lqr'], not {laws!r}")
    for law in laws:
        if list(laws).count(law) > 1:
            raise PantographError(f"law {law!r} is named twice; what varies it belongs into a sweep")
    for word, values in sweep.items():
        if isinstance(values, str | Mapping) or not hasattr(values, "__len__") or not len(values):
            raise PantographError(f"a sweep of {word!r} is a list of values, as [2.0, 5.0], not {values!r}")
    for value in sweep.get(PERIOD, ()):
        positive(PERIOD, value)


def told(scene: Scene, law: str) -> dict[str, Any]:
    """The words of the scene's controller that a law knows."""
    own = scene.controller.parameters if scene.controller else {}
    known = known_words(law)
    return {word: value for word, value in own.items() if word in known}


def _words_of(law: str, base: str, sweep: Mapping[str, Sequence[Any]]) -> tuple[str, ...]:
    if law != ILC:
        return known_words(law)
    learning = [str(of) for of in sweep.get("of", (base,))]
    return (*ILC_WORDS, *(word for of in learning for word in known_words(of)))


def _check(law: str, base: str, words: Mapping[str, Any]) -> None:
    """Raise SceneError for words that a law, or the one that learns, does not know."""
    if law != ILC:
        check_law(law, dict(words))
        return
    check_law(str(words.get("of", base)), {w: x for w, x in words.items() if w not in ILC_WORDS})
