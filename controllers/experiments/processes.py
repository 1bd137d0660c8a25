"""Work spread over processes that Ctrl-C ends at once."""

from __future__ import annotations

import os
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process, resource_tracker
from threading import Thread
from typing import Any, TypeVar

J = TypeVar("J")
R = TypeVar("R")

GUARD = (
    'processes import the script that starts them: put what it does under if __name__ == "__main__":, or ask '
    "for processes=1"
)


class Crew:
    """So many ``processes`` that do jobs, or this one alone; each begins with ``begin(*given)``.

    Leaving it with an error, also KeyboardInterrupt, ends them without waiting for what they do: Ctrl-C is
    this process's alone to hear. When they cannot begin, a warning says why and this one does it all.
    """

    def __init__(self, processes: int, begin: Callable[..., None], given: tuple[Any, ...]) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._others = set(active_children())
        if processes > 1:
            self._pool = ProcessPoolExecutor(
                processes, mp_context=get_context("spawn"), initializer=_begin, initargs=(begin, given)
            )

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            for process in set(active_children()) - self._others:
                process.kill()
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def each(
        self, jobs: Sequence[J], there: Callable[[J], R], here: Callable[[J], R], *, together: bool = True
    ) -> Iterator[tuple[J, R]]:
        """Pairs of a job and its result as they are done, by ``there`` in other processes or ``here`` in this
        one; one after the other, nothing beside, unless ``together``."""
        left = list(jobs)
        try:
            if self._pool is not None:
                for some in [left[:]] if together else [[job] for job in left]:
                    with _unheard():
                        doing: dict[Future[R], J] = {self._pool.submit(there, job): job for job in some}
                    for done in as_completed(doing):
                        result = done.result()
                        left.remove(doing[done])
                        yield doing[done], result
        except BrokenProcessPool:
            warnings.warn(f"processes ended before they began; one goes on alone: {GUARD}", stacklevel=4)
            self._pool = None
        for job in left:
            yield job, here(job)


def _begin(begin: Callable[..., None], given: tuple[Any, ...]) -> None:
    """Begin in a process that ends with the one that started it, however that ends."""
    Thread(target=_end_with_parent, daemon=True).start()
    begin(*given)


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _unheard() -> Iterator[None]:
    """Ctrl-C waits, and processes that begin meanwhile never hear it."""
    if not hasattr(signal, "pthread_sigmask"):  # not on every system
        yield
        return
    resource_tracker.ensure_running()  # starting it would let Ctrl-C through
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
