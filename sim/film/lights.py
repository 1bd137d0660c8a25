"""Lights of a film: placed and keyed by the scene, taken from the model file, or the default three."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FilmError

Floats = NDArray[np.floating]
Curve = Callable[[float], ArrayLike]

KINDS = ("directional", "point", "spot")


@dataclass(frozen=True)
class Light:
    """A light; `position`, `target`, `color` and `intensity` may each be a function of time (s).

    A directional light shines along target - position everywhere; a point light to all sides; a spot in a
    cone of half-angle `cutoff` (rad) about target - position, brightest on the axis (`cos(angle)**exponent`).
    A surface that faces a white light of intensity 1 shows its own colour at full brightness. `color` is
    display RGB in 0..1. Point and spot lights fade with distance d as 1 / (c0 + c1 d + c2 d^2), c being
    `attenuation`; the default does not fade.

    `shadow`: directional and spot lights cast shadows; so does a point light, within 60 degrees of the
    direction to the middle of the scene.
    """

    name: str
    kind: Literal["directional", "point", "spot"] = "directional"
    position: ArrayLike | Curve = (0.0, 0.0, 1.0)
    target: ArrayLike | Curve = (0.0, 0.0, 0.0)
    color: ArrayLike | Curve = (1.0, 1.0, 1.0)
    intensity: float | Callable[[float], float] = 1.0
    shadow: bool = True
    cutoff: float = np.pi / 4
    exponent: float = 1.0
    attenuation: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise FilmError(
                f"light {self.name!r}: kind {self.kind!r} does not exist; there are: {', '.join(KINDS)}"
            )
        if not 0 < self.cutoff < np.pi / 2:
            raise FilmError(f"light {self.name!r}: cutoff must lie between 0 and pi/2 rad, not {self.cutoff}")

    def at(self, t: float) -> "LitNow":
        """The light at time `t` (s)."""
        position = vector(self.position, t, 3, f"position of light {self.name!r}")
        target = vector(self.target, t, 3, f"target of light {self.name!r}")
        length = float(np.linalg.norm(target - position))
        if length == 0 and self.kind != "point":
            raise FilmError(f"light {self.name!r}: position and target coincide at t = {t:.3f} s")
        return LitNow(
            self.kind,
            position,
            (target - position) / length if length else np.array([0.0, 0.0, -1.0]),
            vector(self.color, t, 3, f"color of light {self.name!r}") ** 2
            * float(self.intensity(t) if callable(self.intensity) else self.intensity),
            self.shadow,
            float(np.cos(self.cutoff)),
            self.exponent,
            self.attenuation,
        )


@dataclass(frozen=True)
class LitNow:
    """A light at one instant, world frame; `radiance` is linear RGB times intensity."""

    kind: str
    position: Floats
    direction: Floats
    radiance: Floats
    shadow: bool
    cos_cutoff: float
    exponent: float
    attenuation: tuple[float, float, float]

    def power_at(self, place: Floats) -> float:
        """Share of the radiance that arrives at `place`, shadows aside."""
        if self.kind == "directional":
            return 1.0
        distance = float(np.linalg.norm(place - self.position))
        c0, c1, c2 = self.attenuation
        power = 1.0 / max(c0 + distance * (c1 + distance * c2), 1e-9)
        if self.kind == "point":
            return power
        along = float((place - self.position) @ self.direction) / max(distance, 1e-9)
        return power * along**self.exponent if along > self.cos_cutoff else 0.0


def vector(value: ArrayLike | Curve, t: float, size: int, what: str) -> Floats:
    """A constant or a curve at time `t`, as `size` finite numbers. Raises FilmError naming `what`."""
    try:
        result = np.asarray(value(t) if callable(value) else value, dtype=float)
    except (TypeError, ValueError) as error:
        raise FilmError(f"{what}: {error}") from error
    if result.shape != (size,) or not np.isfinite(result).all():
        raise FilmError(f"{what} at t = {t:.3f} s must be {size} finite numbers, not {result.tolist()}")
    return result


def default_lights(center: ArrayLike, extent: float) -> tuple[Light, ...]:
    """A warm key light with a shadow, a cool fill and a rim light, about a scene of size `extent` (m)."""
    middle = np.asarray(center, dtype=float)

    def light(name: str, toward: ArrayLike, color: ArrayLike, intensity: float, shadow: bool) -> Light:
        position = middle + 3 * extent * np.asarray(toward, dtype=float)
        return Light(name, "directional", position, middle, color, intensity, shadow)

    return (
        light("key", (-0.75, -0.5, 1.1), (1.0, 0.97, 0.92), 0.8, True),
        light("fill", (1.0, -0.4, 0.45), (0.88, 0.94, 1.0), 0.2, False),
        light("rim", (0.3, 1.0, 0.6), (1.0, 1.0, 1.0), 0.25, False),
    )


def model_lights(model: mujoco.MjModel, data: mujoco.MjData) -> list[LitNow]:
    """The model file's active lights at the pose in `data` (after `mj_camlight`), headlight not included."""
    kinds = {0: "spot", 1: "directional", 2: "point"}
    return [
        LitNow(
            kinds.get(int(model.light_type[i]), "point"),
            data.light_xpos[i].copy(),
            data.light_xdir[i].copy(),
            model.light_diffuse[i].astype(float) ** 2,
            bool(model.light_castshadow[i]),
            float(np.cos(np.deg2rad(min(model.light_cutoff[i], 89.0)))),
            float(model.light_exponent[i]),
            (
                float(model.light_attenuation[i, 0]),
                float(model.light_attenuation[i, 1]),
                float(model.light_attenuation[i, 2]),
            ),
        )
        for i in range(model.nlight)
        if model.light_active[i]
    ]
