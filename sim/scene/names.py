"""Names of a compiled model, and the patterns by which a scene refers to them."""

from __future__ import annotations

from fnmatch import fnmatchcase

import mujoco

from ...models import name_of
from ..errors import unknown

COUNT = {
    "joint": "njnt",
    "body": "nbody",
    "actuator": "nu",
    "geom": "ngeom",
    "site": "nsite",
    "camera": "ncam",
    "light": "nlight",
}


class Names:
    """Ids by name, for one kind of thing in a model."""

    def __init__(self, model: mujoco.MjModel, kind: str) -> None:
        self.kind = kind
        self.ids = {name_of(model, kind, i): i for i in range(int(getattr(model, COUNT[kind])))}

    def match(self, pattern: str) -> list[int]:
        """Ids that a name or pattern with * means; none when nothing matches."""
        if pattern in self.ids:
            return [self.ids[pattern]]
        return [i for name, i in self.ids.items() if fnmatchcase(name, pattern)]

    def missing(self, pattern: str) -> str:
        """Message for a pattern that matches nothing."""
        if any(c in pattern for c in "*?["):
            return f"no {self.kind} matches {pattern!r}; there is: {', '.join(sorted(self.ids))}"
        return unknown(self.kind, pattern, self.ids, where="the scene")
