"""Reading scene files: every mistake at once, each with its place."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ..errors import SceneError
from .build import check
from .mistakes import Mistake, Path_, report
from .schema import Scene

_NAME = r"""(?:[\w-]+|"[^"]*"|'[^']*')"""
_HEADER = re.compile(rf"^\s*(\[\[?)\s*({_NAME}(?:\s*\.\s*{_NAME})*)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(rf"^\s*({_NAME}(?:\s*\.\s*{_NAME})*)\s*=")
_STRING = re.compile(r'"(?:\\.|[^"\\])*"|\'[^\']*\'|#.*')


def load_scene(path: str | Path) -> Scene:
    """Read and check a scene file (TOML, see ``pantograph new``).

    Names of joints and files are checked too, so that one report lists all mistakes.
    Raises SceneError with every mistake, its line and what would be right.
    """
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        folder = path.parent if path.parent.is_dir() else Path.cwd()
        near = ", ".join(sorted(p.name for p in folder.glob("*.toml"))) or "no .toml file"
        raise SceneError(f"no scene file {path}; {folder} has: {near}") from None
    except IsADirectoryError:
        raise SceneError(f"{path} is a folder; give the scene file in it") from None
    except UnicodeDecodeError as e:
        raise SceneError(f"{path} is not UTF-8 text (byte {e.start}); scenes are TOML files") from None
    except OSError as e:
        raise SceneError(f"cannot read {path}: {e.strerror}") from None
    return parse_scene(text, file=str(path), base=path.parent)


def parse_scene(text: str, *, file: str = "scene", base: Path | None = None) -> Scene:
    """A scene from TOML text; ``file`` names it in errors, ``base`` resolves its relative paths."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise SceneError(f"{file}: not valid TOML: {e}") from None
    lines = locate(text)
    scene, mistakes, moved = _validate(data)
    if scene is not None:
        scene._base, scene._lines, scene._file = base, lines, file
        for m in check(scene):
            index = moved.get(m.path[:2])
            mistakes.append(m if index is None else Mistake((m.path[0], index, *m.path[2:]), m.message))
    if mistakes:
        raise report(mistakes, file, lines)
    assert scene is not None
    return scene


def _validate(data: dict[str, Any]) -> tuple[Scene | None, list[Mistake], dict[Path_, int]]:
    """The scene less its malformed items, their mistakes, and (list, new index) -> index in the file."""
    try:
        return Scene(**data), [], {}
    except ValidationError as e:
        mistakes = [Mistake(_path(err["loc"]), _say(err)) for err in e.errors()]
    bad = {
        m.path[:2] if m.path and isinstance(data.get(str(m.path[0])), list) else m.path[:1] for m in mistakes
    }
    pruned: dict[str, Any] = {"duration": 1.0}
    moved: dict[Path_, int] = {}
    for key, value in data.items():
        if isinstance(value, list):
            kept = [i for i in range(len(value)) if (key, i) not in bad]
            pruned[key] = [value[i] for i in kept]
            moved |= {(key, new): old for new, old in enumerate(kept)}
        elif (key,) not in bad:
            pruned[key] = value
    # names cannot be checked against models that are not there
    if any(b[:1] in ((), ("models",), ("props",)) for b in bad):
        return None, mistakes, moved
    try:
        return Scene(**pruned), mistakes, moved
    except ValidationError:
        return None, mistakes, moved


def _path(loc: tuple[str | int, ...]) -> Path_:
    """Pydantic's location without the names of union members and types, which are not in the file."""
    return tuple(p for p in loc if isinstance(p, int) or (re.fullmatch(r"[a-z_]+", p) and p not in _MEMBERS))


_MEMBERS = {"float", "int", "bool", "str", "auto", "model", "none", "constrained-float"}


def _say(error: Any) -> str:
    """Pydantic's finding in a person's words, with what was given."""
    kind, given = error["type"], error.get("input")
    if kind == "extra_forbidden":
        return "there is no such word here; 'pantograph schema' lists them"
    if kind == "missing":
        return "is missing"
    if kind == "value_error":
        return str(error["ctx"]["error"])
    shown = repr(given) if not isinstance(given, dict | list) or len(repr(given)) < 60 else "what is given"
    return f"{error['msg'][0].lower()}{error['msg'][1:]}, got {shown}"


def locate(text: str) -> dict[Path_, int]:
    """Line (from 1) of every table and key of a TOML text, by its path."""
    lines: dict[Path_, int] = {}
    counts: dict[Path_, int] = {}
    table: Path_ = ()
    depth, fence = 0, ""
    for number, line in enumerate(text.splitlines(), start=1):
        if fence:
            if fence in line:
                fence = ""
            continue
        if depth == 0:
            if header := _HEADER.match(line):
                table = _names(header[2])
                # [models.x] below [[models]] means the latest of them
                table = tuple(x for i in range(len(table)) for x in _indexed(table[: i + 1], counts))
                if header[1] == "[[":
                    plain = _names(header[2])
                    counts[plain] = counts.get(plain, -1) + 1
                    table = (*(table[:-1] if isinstance(table[-1], int) else table), counts[plain])
                lines.setdefault(table, number)
                continue
            if key := _KEY.match(line):
                lines.setdefault((*table, *_names(key[1])), number)
        bare = _STRING.sub("", line)
        for quotes in ('"""', "'''"):
            if bare.count(quotes) % 2 or line.count(quotes) % 2:
                fence = quotes
        depth = max(0, depth + sum(bare.count(c) for c in "[{") - sum(bare.count(c) for c in "]}"))
    return lines


def _names(dotted: str) -> Path_:
    return tuple(n.strip("\"'") for n in re.findall(_NAME, dotted))


def _indexed(path: Path_, counts: Mapping[Path_, int]) -> Path_:
    return (path[-1], counts[path]) if path in counts else (path[-1],)
