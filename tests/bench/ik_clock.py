"""Times of calls by processor and by wall clock, and whether the system took the processor away."""

import resource
import time
from typing import NamedTuple

import numpy as np


class Times(NamedTuple):
    """Seconds (k,) of processor and of wall clock, and whether the system took the processor away."""

    processor: np.ndarray
    wall: np.ndarray
    taken: np.ndarray


def clocked(calls):
    """Times of calls one by one; switches of the thread are counted by the system."""
    rows = []
    for call in calls:
        before = resource.getrusage(resource.RUSAGE_THREAD)
        wall, begin = time.perf_counter(), time.thread_time()
        call()
        spent, wall = time.thread_time() - begin, time.perf_counter() - wall
        after = resource.getrusage(resource.RUSAGE_THREAD)
        rows.append((spent, wall, after.ru_nivcsw - before.ru_nivcsw + after.ru_nvcsw - before.ru_nvcsw))
    spent, wall, switches = np.array(rows).T
    return Times(spent, wall, switches > 0)


def spin(seconds):
    """Do nothing for so long."""
    begin = time.thread_time()
    while time.thread_time() - begin < seconds:
        pass
