"""The command line."""

from __future__ import annotations

import os
import signal
import sys
from typing import Any


def main() -> None:
    """Entry point of the command ``pantograph``.

    Ctrl-C ends it with a line and status 130: at once while libraries load, where an exception could get lost
    in one of them; as the commands say while they work; silently when nothing but leaving is left to do.
    """
    wanted = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not ignored, as in background
    if wanted:
        signal.signal(signal.SIGINT, _leave)
    try:
        from .app import run_app
    except ImportError as error:
        if "MUJOCO_GL" not in str(error):
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    if wanted:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        run_app()
    finally:
        if wanted:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


def _leave(number: int, frame: Any) -> None:
    os.write(2, b"interrupted\n")
    os._exit(130)
