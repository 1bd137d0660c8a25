"""What is wrong in a scene, and where: all of it in one report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ..errors import SceneError

Path_ = tuple[str | int, ...]


@dataclass(frozen=True)
class Mistake:
    """One thing wrong in a scene: where (path into the scene) and what.

    ``needs`` names parts of the scene: if items of these were left out for mistakes of their own, this one
    may only follow from that.
    """

    path: Path_
    message: str
    needs: tuple[str, ...] = ()


class SceneMistakes(SceneError):
    """A scene with mistakes, and these one by one."""

    def __init__(self, text: str, mistakes: tuple[Mistake, ...]) -> None:
        super().__init__(text)
        self.mistakes = mistakes


def place(path: Path_) -> str:
    """``('keys', 2, 'times')`` as ``keys[2].times``."""
    out = ""
    for part in path:
        out += f"[{part}]" if isinstance(part, int) else f".{part}" if out else part
    return out or "scene"


def report(mistakes: Iterable[Mistake], scene_file: str, lines: Mapping[Path_, int]) -> SceneMistakes:
    """All mistakes as one error, in the order of the file."""

    def line(path: Path_) -> int:
        while path and path not in lines:
            path = path[:-1]
        return lines.get(path, 0)

    unique = {(m.path, m.message): m for m in mistakes}
    ordered = sorted(unique.values(), key=lambda m: (line(m.path), place(m.path)))
    rows = []
    for m in ordered:
        at = f"line {line(m.path)}, " if line(m.path) else ""
        message = m.message.replace("\n", "\n    ")
        rows.append(f"  {at}{place(m.path)}: {message}")
    count = "1 mistake" if len(rows) == 1 else f"{len(rows)} mistakes"
    return SceneMistakes(f"{scene_file}: {count}\n" + "\n".join(rows), tuple(ordered))
