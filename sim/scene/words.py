"""What pydantic finds wrong in a scene, in a person's words and once for each place."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any, NamedTuple, get_args

from pydantic import BaseModel, ValidationError

from ..errors import unknown
from .mistakes import Mistake, Path_, place

_KINDS = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing": "a whole number",
    "bool_type": "true or false",
    "string_type": "a text in quotes",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
}
_BOUNDS = {
    "greater_than": "greater than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "less than {lt:g}",
    "less_than_equal": "at most {le:g}",
    "finite_number": "a finite number",
}


class _Finding(NamedTuple):
    """One error of pydantic: its path in the data, and where on it the forms of a union part."""

    path: Path_
    fork: Path_ | None
    form: str
    error: Any


def mistakes_of(error: ValidationError, data: Any, scene: type[BaseModel]) -> list[Mistake]:
    """Mistakes of ``data`` as a ``scene``, one a place: of a value that may take several forms, those of the
    form that it is nearest to."""
    findings = [_finding(e, data) for e in error.errors()]
    out = []
    for fork, group in groupby(findings, key=lambda f: f.fork):
        found = list(group)
        if fork is not None:
            found = _nearest(found)
        kinds = [_kind(f.error) for f in found]
        if fork is not None and all(kinds) and all(f.path == fork for f in found):
            out.append(Mistake(fork, _must_be([k for k in kinds if k], found[0].error)))
        else:
            out += [Mistake(f.path, _say(f, scene)) for f in found]
    return out


def _finding(error: Any, data: Any) -> _Finding:
    """Pydantic's location less the forms of unions that it names on the way."""
    path: list[str | int] = []
    fork, form, at = None, "", data
    for i, part in enumerate(error["loc"]):
        last = i == len(error["loc"]) - 1
        named = isinstance(at, dict) and (part in at or last)
        listed = isinstance(at, list | tuple) and isinstance(part, int)
        if isinstance(at, BaseModel) and hasattr(at, str(part)):
            path.append(part)
            at = getattr(at, str(part))
        elif named or listed or (last and error["type"] == "said"):
            path.append(part)
            at = at[part] if not last or (named and part in at) else None
        elif fork is None:
            fork, form = tuple(path), str(part)
    return _Finding(tuple(path), fork, form, error)


def _nearest(found: Sequence[_Finding]) -> list[_Finding]:
    """Findings of the form that was meant: of the right kind, else the one that fits most deeply."""
    forms: dict[str, list[_Finding]] = {}
    for f in found:
        forms.setdefault(f.form, []).append(f)
    rank = {
        form: (all(_kind(f.error) is None for f in fs), max(len(f.path) for f in fs))
        for form, fs in forms.items()
    }
    best = max(rank.values())
    return [f for form, fs in forms.items() if rank[form] == best for f in fs]


def _kind(error: Any) -> str | None:
    """What belongs at a place where something of another kind is."""
    if error["type"] == "kind":
        return str(error["ctx"]["kind"])
    if error["type"] == "literal_error":
        return str(error["ctx"]["expected"])
    return _KINDS.get(error["type"])


def _must_be(kinds: Sequence[str], error: Any) -> str:
    return f"must be {', or '.join(dict.fromkeys(kinds))}, got {_shown(error['input'])}"


def _say(finding: _Finding, scene: type[BaseModel]) -> str:
    path, error = finding.path, finding.error
    if kind := _kind(error):
        if error["type"] == "list_type" and isinstance(error["input"], dict) and len(path) == 1:
            return f"there can be several: write [[{path[0]}]] in double brackets"
        if error["type"].startswith("model") and isinstance(error["input"], list) and len(path) == 1:
            return f"there is only one: write [{path[0]}] in single brackets"
        return _must_be([kind], error)
    if error["type"] in _BOUNDS:
        return (
            f"must be {_BOUNDS[error['type']].format(**error.get('ctx', {}))}, got {_shown(error['input'])}"
        )
    if error["type"] == "too_short":
        return "is empty"
    if error["type"] == "string_pattern_mismatch":
        return f"must be of letters, digits and . _ -, got {_shown(error['input'])}"
    if error["type"] == "missing":
        return "is missing"
    if error["type"] == "extra_forbidden":
        return _no_word(path, scene)
    return str(error["msg"])


def _no_word(path: Path_, scene: type[BaseModel]) -> str:
    word, where = str(path[-1]), place(path[:-1])
    message = unknown("word", word, _words(scene, path[:-1]), where="a scene" if len(path) == 1 else where)
    if len(path) > 1 and word in scene.model_fields:
        message += f". If the scene's own {word!r} is meant: it belongs above the first [table] of the file"
    return message


def _words(model: type[BaseModel], path: Path_) -> list[str]:
    """The words that an item of a scene has."""
    for part in path:
        if isinstance(part, str):
            model = _item(model.model_fields[part].annotation) or model
    return list(model.model_fields)


def _item(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for a in get_args(annotation) if (found := _item(a))), None)


def _shown(given: Any) -> str:
    if isinstance(given, bool):
        return str(given).lower()
    text = repr(given)
    return text if len(text) < 60 else "something else"
