"""Goals of a scene: curves of what is wanted, baked to curves of joints or followed live.

A goal is baked when all that it depends on is known before the run: keys, and joints that goals move. It is
live when it hangs on what physics moves, or when the scene asks for it.
"""

from .assign import Goals, assign
from .bake import bake
from .told import deviations, sentences
from .wanted import Wanted, together

__all__ = ["Goals", "Wanted", "assign", "bake", "deviations", "sentences", "together"]
