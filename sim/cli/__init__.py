"""The command line."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def main() -> None:
    """Entry point of the command ``pantograph``.

    Ctrl-C ends it with a line and status 130: once libraries are loaded; as the commands say while they work;
    silently when nothing but leaving is left to do.
    """
    try:
        with _uninterrupted():
            from .app import run_app
        run_app()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except ImportError as error:
        if "MUJOCO_GL" not in str(error):
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    finally:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not ignored, as in background
            signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Ctrl-C waits: libraries that load lose exceptions, and start processes that would tell of it too."""
    if not hasattr(signal, "pthread_sigmask"):  # not on every system
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
