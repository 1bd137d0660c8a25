"""Films of recordings: the cameras and lights of the scene that made them, keyed or not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from .curves import Curve
from .errors import FilmError
from .film import Camera, Light, film, still
from .recording import Array, Recording
from .scene.motion import film_curves
from .scene.schema import CameraItem, LightItem, Scene


def shoot(
    recording: Recording,
    path: str | Path,
    *,
    camera: str | None = None,
    size: tuple[int, int] | None = None,
    fps: float | None = None,
    shadows: bool | None = None,
    at: float | None = None,
    beside: Recording | None = None,
    progress: bool = True,
) -> Path:
    """Film a recording, or take one picture of it ``at`` a time [s]; returns the path written.

    ``beside`` is another recording of the same model, such as what a rig made of it, drawn to the right.

    What is not given comes from the scene: camera by name (of the scene or of the model file), size in
    pixels, frames per second, shadows. Raises FilmError for an unknown camera, an empty recording or
    what :func:`pantograph.sim.film.film` raises.
    """
    if beside is not None and beside.q.shape[1] != recording.q.shape[1]:
        raise FilmError(
            f"the recording beside has {beside.q.shape[1]} coordinates, this one {recording.q.shape[1]}: "
            "both must be of the same model"
        )
    if not len(recording.t):
        raise FilmError("the recording is empty; there is nothing to film")
    scene = Scene(**recording.scene)
    name = camera or scene.film.camera or (scene.cameras[0].name if scene.cameras else None)
    size = size or (scene.film.width, scene.film.height)
    view = None if name is None else _camera(name, scene, recording)
    lights = _lights(scene) or None
    shadows = scene.film.shadows if shadows is None else shadows
    if at is not None:
        if not recording.t[0] <= at <= recording.t[-1]:
            raise FilmError(f"no picture at t = {at:g} s: the recording ends at {recording.t[-1]:g} s")
        k = int(np.argmin(np.abs(recording.t - at)))
        return still(
            recording.model,
            recording.q[k],
            path,
            t=at,
            camera=view,
            lights=lights,
            size=size,
            shadows=shadows,
        )
    return film(
        recording.model,
        recording.t,
        recording.q,
        path,
        beside=None if beside is None else (beside.t, beside.q),
        camera=view,
        lights=lights,
        fps=fps or scene.film.fps,
        size=size,
        shadows=shadows,
        progress=progress,
    )


def _camera(name: str, scene: Scene, recording: Recording) -> Camera:
    items = {c.name: c for c in scene.cameras}
    if name not in items:
        model = recording.model
        own = [model.camera(i).name for i in range(model.ncam)]
        if name in own:
            return Camera(name, "model", frame=name)
        listing = ", ".join([*items, *own]) or "none (the film frames the whole motion by itself)"
        raise FilmError(f"no camera {name!r}; there is: {listing}")
    return camera_of(items[name], scene)


def camera_of(item: CameraItem, scene: Scene) -> Camera:
    """The film's camera for an item of the scene, with its keys."""
    keyed, unit = film_curves(scene)[0], np.pi / 180 if scene.angle == "degree" else 1.0
    defaults = Camera()
    position = _keyed_or(keyed, item.name, "position", item.position or (2.0, -2.0, 1.5))
    target = _keyed_or(keyed, item.name, "target", item.target or (0.0, 0.0, 0.0))
    fovy = keyed.get((item.name, "fovy"))
    return Camera(
        name=item.name,
        kind=item.kind,
        position=position,
        target=target,
        frame=item.name if item.kind == "model" else item.body,
        fovy=float(np.deg2rad(item.fovy)) if fovy is None else _radians(fovy),
        radius=item.radius or defaults.radius,
        elevation=item.elevation * unit,
        azimuth=item.azimuth * unit,
        period=item.period or defaults.period,
    )


def _lights(scene: Scene) -> list[Light]:
    return [light_of(item, scene) for item in scene.lights]


def light_of(item: LightItem, scene: Scene) -> Light:
    """The film's light for an item of the scene, with its keys."""
    keyed = film_curves(scene)[1]
    intensity = keyed.get((item.name, "intensity"))
    return Light(
        name=item.name,
        kind=item.kind,
        position=_keyed_or(keyed, item.name, "position", item.position),
        target=_keyed_or(keyed, item.name, "target", item.target),
        color=_keyed_or(keyed, item.name, "color", item.color),
        intensity=item.intensity if intensity is None else _number(intensity),
        shadow=item.shadow,
    )


def _keyed_or(
    curves: dict[tuple[str, str], Curve], name: str, channel: str, value: ArrayLike
) -> Callable[[float], Array] | ArrayLike:
    curve = curves.get((name, channel))
    if curve is None:
        return value
    return lambda t: curve(t).q


def _number(curve: Curve) -> Callable[[float], float]:
    return lambda t: float(curve(t).q[0])


def _radians(curve: Curve) -> Callable[[float], float]:
    return lambda t: float(np.deg2rad(curve(t).q[0]))
