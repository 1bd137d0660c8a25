"""IPOPT with Ctrl-C: CasADi takes an interrupt for an evaluation that failed, and goes on."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def watch(variables: int, constraints: int, each: Callable[[int], None] | None = None) -> Any:
    """An ``iteration_callback`` for CasADi's solvers, told the number of each iteration.

    Keep it while the solver lives. Setting its ``stopped`` ends the solver with the next iteration.
    """
    import casadi as ca

    class Watch(ca.Callback):
        def __init__(self) -> None:
            ca.Callback.__init__(self)
            self.count, self.stopped = 0, False
            self.construct("watch")

        def get_n_in(self) -> int:
            return int(ca.nlpsol_n_out())

        def get_n_out(self) -> int:
            return 1

        def get_sparsity_in(self, i: int) -> Any:
            sizes = {"f": 1, "x": variables, "lam_x": variables, "g": constraints, "lam_g": constraints}
            return ca.Sparsity.dense(sizes.get(ca.nlpsol_out(i), 0), 1)

        def eval(self, arg: Any) -> list[int]:
            self.count += 1
            if each is not None:
                each(self.count)
            return [int(self.stopped)]

    return Watch()


@contextmanager
def interruptible(guard: Any) -> Iterator[None]:
    """Ctrl-C stops the solver that ``guard`` watches, and is raised as KeyboardInterrupt at the end."""

    def stop(number: int, frame: object) -> None:
        guard.stopped = True

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if guard.stopped:
        raise KeyboardInterrupt
