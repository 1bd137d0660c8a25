"""The command line."""

from __future__ import annotations


def main() -> None:
    """Entry point of the command ``pantograph``."""
    from .app import run_app

    run_app()
