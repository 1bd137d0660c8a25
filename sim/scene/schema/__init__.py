"""What a scene can say: the same objects whether written as TOML or in Python (format 1)."""

from .film import CameraItem, FilmItem, LightItem
from .goal import GoalItem
from .item import Item
from .scene import ControllerItem, Initial, Physics, Roles, Scene, Solver
from .things import ChainItem, ModelItem, Placement, PropItem
from .timed import ForceItem, KeysItem

__all__ = [
    "CameraItem",
    "ChainItem",
    "ControllerItem",
    "FilmItem",
    "ForceItem",
    "GoalItem",
    "Initial",
    "Item",
    "KeysItem",
    "LightItem",
    "ModelItem",
    "Physics",
    "Placement",
    "PropItem",
    "Roles",
    "Scene",
    "Solver",
]
