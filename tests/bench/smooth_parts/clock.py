"""Times of calls measured in turn, so that what else the machine does falls on all alike."""

import math
import time
from collections.abc import Callable, Mapping

import numpy as np

LEAST = 0.02  # a round of a call takes at least so long [s]


def alternating(
    calls: Mapping[str, Callable[[], object]],
    rounds: int = 9,
    clock: Callable[[], float] = time.process_time,
    least: float = LEAST,
) -> dict[str, np.ndarray]:
    """Seconds of one call of each, shape (rounds,); quick ones are called again and again in a round."""
    repeats = {}
    for name, call in calls.items():
        call()
        repeats[name] = max(1, math.ceil(least / max(_seconds(call, 1, clock), 1e-9)))
    out: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            out[name].append(_seconds(call, repeats[name], clock))
    return {name: np.array(values) for name, values in out.items()}


def _seconds(call, repeats, clock):
    begin = clock()
    for _ in range(repeats):
        call()
    return (clock() - begin) / repeats
