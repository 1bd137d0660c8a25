"""Experiments: the same scene under several laws, as modelled and disturbed, in one table and one picture."""

from .comparison import Comparison, Row, compare
from .disturb import Spread, disturbances
from .pictures import figure, learning
from .variants import Variant, told

__all__ = [
    "Comparison", "Row", "Spread", "Variant", "compare", "disturbances", "figure", "learning", "told",
]  # fmt: skip
