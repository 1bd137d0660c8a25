"""Reading scene files: every mistake at once, each with its place."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import SceneError
from ..plan import Plan, try_plan
from .mistakes import Mistake, Path_, SceneMistakes, report
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
    return read(path)[0]


def read(path: str | Path) -> tuple[Scene, Plan]:
    """The scene in a file, and its plan, which the search for mistakes has to make anyway; see load_scene."""
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
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
    return _parse(text, str(path), path.parent)


def parse_scene(text: str, *, file: str = "scene", base: Path | None = None) -> Scene:
    """A scene from TOML text; ``file`` names it in errors, ``base`` resolves its relative paths."""
    return _parse(text, file, base)[0]


def _parse(text: str, file: str, base: Path | None) -> tuple[Scene, Plan]:
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise SceneError(f"{file}: {_syntax(str(e), text)}") from None
    lines = locate(text)
    scene, mistakes, moved = _validate(data)
    plan: Plan | None = None
    if scene is not None:
        scene._base, scene._lines, scene._file = base, lines, file
        malformed = {str(m.path[0]) for m in mistakes if m.path}
        plan, further = try_plan(scene)
        for m in further:
            index = moved.get(m.path[:2])
            path = m.path if index is None else (m.path[0], index, *m.path[2:])
            if not malformed.intersection(m.needs):
                mistakes.append(Mistake(path, m.message))
    if mistakes:
        raise report(mistakes, file, lines)
    assert scene is not None
    assert plan is not None
    return scene, plan


def _syntax(message: str, text: str) -> str:
    """What the parser says, with the line that it means."""
    found = re.fullmatch(r"(.*) \(at (?:line (\d+), column (\d+)|end of document)\)", message, re.DOTALL)
    if found is None:
        return f"not valid TOML: {message}"
    said, lines = found[1][0].lower() + found[1][1:], text.split("\n")
    if found[2] is None:
        return f"not valid TOML at the end of the file: {said}"
    number = int(found[2])
    return f"line {number}, column {found[3]}, not valid TOML: {said}\n  {lines[number - 1].strip()}"


def _validate(data: dict[str, Any]) -> tuple[Scene | None, list[Mistake], dict[Path_, int]]:
    """The scene less its malformed items, their mistakes, and (list, new index) -> index in the file."""
    try:
        return Scene(**data), [], {}
    except SceneMistakes as e:
        mistakes = list(e.mistakes)
    bad = {m.path[:2] for m in mistakes}
    pruned: dict[str, Any] = {}
    moved: dict[Path_, int] = {}
    for key, value in data.items():
        if isinstance(value, list):
            kept = [i for i in range(len(value)) if (key, i) not in bad]
            pruned[key] = [value[i] for i in kept]
            moved |= {(key, new): old for new, old in enumerate(kept)}
        else:
            tables = isinstance(value, dict)
            pruned[key] = {k: v for k, v in value.items() if (key, k) not in bad} if tables else value
    pruned = {k: v for k, v in pruned.items() if k in Scene.model_fields and (k,) not in bad}
    # names cannot be checked against models that are not there
    if any(b[:1] in ((), ("models",), ("props",)) for b in bad):
        return None, mistakes, moved
    try:
        return Scene(**{"duration": 1.0, **pruned}), mistakes, moved
    except SceneMistakes:
        return None, mistakes, moved


def locate(text: str) -> dict[Path_, int]:
    """Line (from 1) of every table and key of a TOML text, by its path."""
    lines: dict[Path_, int] = {}
    counts: dict[Path_, int] = {}
    table: Path_ = ()
    depth, fence = 0, ""
    for number, line in enumerate(text.split("\n"), start=1):
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
                _note(lines, table, number)
                continue
            if key := _KEY.match(line):
                _note(lines, (*table, *_names(key[1])), number)
        bare = _STRING.sub("", line)
        for quotes in ('"""', "'''"):
            if bare.count(quotes) % 2 or line.count(quotes) % 2:
                fence = quotes
        depth = max(0, depth + sum(bare.count(c) for c in "[{") - sum(bare.count(c) for c in "]}"))
    return lines


def _note(lines: dict[Path_, int], path: Path_, number: int) -> None:
    """A path and the tables that it opens on its way are first seen on a line."""
    for i in range(1, len(path) + 1):
        lines.setdefault(path[:i], number)


def _names(dotted: str) -> Path_:
    return tuple(n.strip("\"'") for n in re.findall(_NAME, dotted))


def _indexed(path: Path_, counts: Mapping[Path_, int]) -> Path_:
    return (path[-1], counts[path]) if path in counts else (path[-1],)
