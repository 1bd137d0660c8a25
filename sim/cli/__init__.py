"""The command line."""

from __future__ import annotations

import sys


def main() -> None:
    """Entry point of the command ``pantograph``."""
    try:
        from .app import run_app
    except KeyboardInterrupt:  # while libraries load
        sys.exit(130)
    run_app()
