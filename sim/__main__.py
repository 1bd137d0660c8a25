"""``python -m pantograph.sim`` is the command ``pantograph``."""

from .cli import main

main()
