"""Films and pictures of a motion, drawn without a window."""

import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FilmError, FilmWarning
from .cameras import Camera
from .lights import Light, default_lights
from .renderer import Renderer
from .video import check_path, check_rate, write

__all__ = ["Camera", "Light", "Renderer", "check_path", "default_lights", "film", "still", "write"]

Floats = NDArray[np.floating]


def film(
    model: mujoco.MjModel,
    t: ArrayLike,
    q: ArrayLike,
    path: str | os.PathLike[str],
    *,
    beside: tuple[ArrayLike, ArrayLike] | None = None,
    camera: Camera | None = None,
    lights: Sequence[Light] | None = None,
    fps: float = 30.0,
    size: tuple[int, int] = (640, 480),
    shadows: bool = True,
    progress: bool = True,
) -> Path:
    """Film the motion q (n, nq) at times t (n,) in seconds, in real time, and return the path.

    What `path` may be: see `write`. Without a `camera`, one that frames the whole motion; without `lights`,
    the model file's or, when it has none, three of our own. Frames fall at t[0] + k / fps; between samples
    the motion is interpolated on the manifold (shortest rotations). `size` is (width, height) in pixels.
    `beside` is a second motion (times, q) of the same model, drawn to the right as the same camera sees it.
    A FilmWarning names what of the model is not drawn.

    Raises FilmError for times that do not rise, wrong shapes, values that are not finite, or a missing
    OpenGL library.
    """
    times, motion = _checked(model, t, q)
    check_rate(fps)
    shot = times[0] + np.arange(int((times[-1] - times[0]) * fps + 1e-9) + 1) / fps
    view = (camera or Camera.auto(model, motion, aspect=size[0] / size[1])).follow(model, times, motion)
    with Renderer(model, width=size[0], height=size[1], lights=lights, shadows=shadows) as renderer:
        _tell(renderer.not_drawn)
        motions = [(times, motion)] if beside is None else [(times, motion), _checked(model, *beside)]
        poses = zip(*(resampled(model, *each, shot) for each in motions), strict=True)
        frames = (
            np.concatenate([renderer.render(q_k, t_k, camera=view) for t_k, q_k in pair], axis=1)
            for pair in poses
        )
        return write(path, frames, fps=fps, total=len(shot), progress=progress)


def still(
    model: mujoco.MjModel,
    q: ArrayLike,
    path: str | os.PathLike[str],
    *,
    t: float = 0.0,
    camera: Camera | None = None,
    lights: Sequence[Light] | None = None,
    size: tuple[int, int] = (640, 480),
    shadows: bool = True,
) -> Path:
    """Picture of the configuration q (nq,), with camera and lights as they are at time `t` (s)."""
    _, motion = _checked(model, [t], np.atleast_2d(np.asarray(q, dtype=float)))
    view = camera or Camera.auto(model, motion, aspect=size[0] / size[1])
    with Renderer(model, width=size[0], height=size[1], lights=lights, shadows=shadows) as renderer:
        _tell(renderer.not_drawn)
        return write(path, [renderer.render(motion[0], t, camera=view)], fps=1.0, progress=False)


def _tell(not_drawn: Sequence[str]) -> None:
    if not_drawn:
        warnings.warn("not drawn: " + "; ".join(not_drawn), FilmWarning, stacklevel=3)


def resampled(model: mujoco.MjModel, t: Floats, q: Floats, times: Floats) -> Iterator[tuple[float, Floats]]:
    """(time, configuration) at `times`, interpolated between the samples along the manifold's geodesics."""
    v = np.empty(model.nv)
    for now in times:
        i = int(np.clip(np.searchsorted(t, now, side="right") - 1, 0, max(len(t) - 2, 0)))
        q_now = q[i].copy()
        if now > t[i] and len(t) > 1:
            step = t[i + 1] - t[i]
            mujoco.mj_differentiatePos(model, v, step, q[i], q[i + 1])
            mujoco.mj_integratePos(model, q_now, v, min(now - t[i], step))
        yield float(now), q_now


def _checked(model: mujoco.MjModel, t: ArrayLike, q: ArrayLike) -> tuple[Floats, Floats]:
    times, motion = np.asarray(t, dtype=float), np.asarray(q, dtype=float)
    if times.ndim != 1 or len(times) == 0 or motion.shape != (len(times), model.nq):
        raise FilmError(
            f"a motion is t (n,) and q (n, {model.nq}) with n >= 1, not {times.shape} and {motion.shape}"
        )
    if not (np.isfinite(times).all() and np.isfinite(motion).all()):
        raise FilmError(
            "the motion holds values that are not finite; film only up to where the run was sound"
        )
    if (np.diff(times) <= 0).any():
        raise FilmError(
            f"times must rise; they do not after t = {times[np.argmax(np.diff(times) <= 0)]:.6g} s"
        )
    return times, motion
