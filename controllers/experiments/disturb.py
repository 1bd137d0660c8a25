"""Disturbances drawn by a seed: what may differ on a machine from what its law believes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...models import names_of
from ...sim.engines.interface import Role
from ...sim.errors import PantographError
from ...sim.plan import Plan
from ...sim.scene.angles import law_words
from ..gains import force_limits, positive, whole
from ..nominal import Nominal
from ..trial import Disturbance


@dataclass(frozen=True)
class Spread:
    """How many disturbances, and how large.

    ``mass``, ``friction``: largest parts by which each body's mass, and each joint's damping and dry
    friction, differ; ``push``: largest part of what drives can give; ``start``: largest offset of each joint
    at the start, in the scene's units, and of its speed in the same a second. All are drawn evenly. Raises
    PantographError for what is no such part: masses stay positive, friction does not drive.
    """

    trials: int = 0
    mass: float = 0.1
    friction: float = 0.0
    push: float = 0.2
    start: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        whole("trials", self.trials, least=0)
        whole("seed", self.seed, least=0)
        for word in ("mass", "friction", "push", "start"):
            positive(word, getattr(self, word), zero=True)
        if self.mass >= 1.0:
            raise PantographError(
                f"mass must be below 1, the part by which masses differ (0.05 is 5 %), got {self.mass:g}: "
                "bodies would weigh less than nothing"
            )
        if self.friction > 1.0:
            raise PantographError(
                f"friction must be at most 1, the part by which it differs (0.5 is 50 %), got "
                f"{self.friction:g}: joints would be driven by it"
            )


def disturbances(plan: Plan, spread: Spread) -> list[Disturbance]:
    """As many disturbances as ``spread`` asks for; the same for every law, and for all of its other sizes."""
    m, rng, out = plan.problem.model, np.random.default_rng(spread.seed), []
    other = np.random.default_rng((spread.seed, 1))  # which leaves masses and pushes as they are without it
    mass, friction, push = spread.mass, spread.friction, spread.push
    tracked, free = plan.problem.dofs(Role.TRACKED), ~plan.problem.dofs(Role.KEYED)
    low, high = force_limits(m)
    able = np.minimum(-low, high)
    q0 = plan.problem.state0.q
    able = np.where(np.isfinite(able), able, np.abs(Nominal(m).weight(q0)).max(initial=1.0))
    duration = plan.problem.duration
    far = np.where(free, law_words(plan.setup.scene, m, {"speed": spread.start})["speed"], 0.0)
    for k in range(spread.trials):
        factors = 1.0 + mass * rng.uniform(-1.0, 1.0, m.nbody)
        forces = np.where(tracked, push * able * rng.uniform(-1.0, 1.0, m.nv), 0.0)
        start = float(rng.uniform(0.1, 0.7) * duration)
        body = 1 + int(np.argmax(np.abs(factors[1:] - 1.0)))  # the first is the world
        heavy = f"{names_of(m, 'body')[body]} x {factors[body]:.3f}"
        rubs = tuple(1.0 + friction * rng.uniform(-1.0, 1.0, m.nv)) if friction else ()
        rough = f", friction x {min(rubs):.2f} to {max(rubs):.2f}" if rubs else ""
        offset, speed = far * other.uniform(-1.0, 1.0, (2, m.nv))
        off = f", start off by up to {np.abs(offset).max():.3g}" if spread.start else ""
        say = f"#{k} of seed {spread.seed}: {heavy}{rough}{off}, push at {start:.2f} s"
        away = (tuple(offset), tuple(speed)) if spread.start else ((), ())
        pushed = (tuple(forces), start, start + 0.1 * duration)
        out.append(Disturbance(tuple(factors), rubs, *pushed, *away, say))
    return out
