"""Names of a compiled model, and the patterns by which a scene refers to them."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Literal

import mujoco

from ...models import names_of
from ..errors import unknown

Kind = Literal["joint", "body", "actuator", "camera"]


class Names:
    """Ids by name, for one kind of thing in a model."""

    def __init__(self, model: mujoco.MjModel, kind: Kind) -> None:
        self.kind = kind
        self.ids = {name: i for i, name in enumerate(names_of(model, kind))}

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
