"""From the keys of a scene to curves: of joints, actuators, cameras and lights."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from ..clip import FreeTrack, Track
from ..curves import Curve, keyed
from ..errors import PantographError
from ..kinds import BALL, FREE, HINGE
from ..rotation_curves import keyed_rotation
from ..rotations import from_euler
from .mistakes import Mistake, Path_
from .names import Names
from .schema import KeysItem, Scene

_WIDTH = {"position": 3, "target": 3, "fovy": 1, "intensity": 1, "color": 3}

FilmCurves = dict[tuple[str, str], Curve]


@dataclass
class Curves:
    """All curves of a scene, by what they move."""

    tracks: dict[int, Track] = field(default_factory=dict)
    actuators: dict[int, Curve] = field(default_factory=dict)
    cameras: FilmCurves = field(default_factory=dict)
    lights: FilmCurves = field(default_factory=dict)


def curves(scene: Scene, model: mujoco.MjModel) -> tuple[Curves, list[Mistake]]:
    """Curves of all keys of the scene; joints and actuators by their id in ``model``."""
    out, mistakes = Curves(), []
    joints, actuators = Names(model, "joint"), Names(model, "actuator")
    parts: dict[int, dict[str, Any]] = {}
    for i, item in enumerate(scene.keys):
        try:
            if item.joint is not None:
                _joint(item, scene, model, joints, parts)
            elif item.actuator is not None:
                if item.actuator not in actuators.ids:
                    raise _At("actuator", actuators.missing(item.actuator))
                _once(out.actuators, actuators.ids[item.actuator], _scalars(item, 1))
            else:
                _film(item, scene, out)
        except _At as e:
            where = ("keys", i, e.word) if e.word else ("keys", i)
            mistakes.append(Mistake(where, e.message, needs=(f"{e.word}s",)))
        except PantographError as e:
            mistakes.append(Mistake(("keys", i, "values"), str(e)))
    for joint, channels in parts.items():
        free = model.jnt_type[joint] == FREE
        out.tracks[joint] = FreeTrack(**channels) if free else next(iter(channels.values()))
    return out, mistakes


class _At(Exception):
    """A mistake at a word of an item."""

    def __init__(self, word: str, message: str) -> None:
        self.word, self.message = word, message


def _once(curves: dict[Any, Curve], key: Any, curve: Curve) -> None:
    if key in curves:
        raise _At("", "this channel has keys already; put them all into one [[keys]]")
    curves[key] = curve


def _joint(
    item: KeysItem,
    scene: Scene,
    model: mujoco.MjModel,
    joints: Names,
    parts: dict[int, dict[str, Any]],
) -> None:
    name = str(item.joint)
    if name not in joints.ids:
        raise _At("joint", joints.missing(name))
    joint = joints.ids[name]
    kind = int(model.jnt_type[joint])
    channels = {FREE: ("position", "rotation"), BALL: ("rotation",)}.get(kind, ("value",))
    channel = item.channel or (channels[0] if len(channels) == 1 else None)
    if channel is None:
        raise _At("joint", f'joint {name!r} is free: its keys need channel = "position" or "rotation"')
    if channel not in channels:
        what = {FREE: "free", BALL: "ball", HINGE: "hinge"}.get(kind, "slide")
        raise _At(
            "channel", f"{what} joint {name!r} has no channel {channel!r}; it has: {', '.join(channels)}"
        )
    if channel == "rotation":
        curve: Curve = _rotations(item, scene)
    else:
        curve = _scalars(item, 3 if channel == "position" else 1)
        if kind == HINGE and scene.angle == "degree":
            curve = _scalars(item, 1, scale=np.pi / 180)
    _once(parts.setdefault(joint, {}), channel, curve)


def _scalars(item: KeysItem, width: int, scale: float = 1.0) -> Curve:
    rows = [r if isinstance(r, list) else [r] for r in item.values]
    if len(rows[0]) != width:
        raise _At("values", f"each value needs {width} number{'s' * (width > 1)}, got {len(rows[0])}")
    return keyed(
        item.times,
        scale * np.asarray(rows),
        kind=item.curve,
        ease=item.ease,
        before=item.before,
        after=item.after,
    )


def _rotations(item: KeysItem, scene: Scene) -> Curve:
    rows = np.asarray([r if isinstance(r, list) else [r] for r in item.values], dtype=float)
    if rows.shape[1] == 3:
        angles = np.deg2rad(rows) if scene.angle == "degree" else rows
        rows = from_euler("xyz", angles)
    if rows.shape[1] != 4:
        got = f"{rows.shape[1]} number{'s' * (rows.shape[1] > 1)}"
        raise _At("values", f"a rotation is w, x, y, z or euler x, y, z; got {got}")
    return keyed_rotation(
        item.times, rows, kind=item.curve, ease=item.ease, before=item.before, after=item.after
    )


def _film(item: KeysItem, scene: Scene, out: Curves) -> None:
    word = "camera" if item.camera is not None else "light"
    name = str(item.camera if item.camera is not None else item.light)
    known = [c.name for c in (scene.cameras if word == "camera" else scene.lights)]
    if name not in known:
        listing = ", ".join(known) or "none"
        raise _At(word, f"no {word} {name!r}; the scene has: {listing}")
    target = out.cameras if word == "camera" else out.lights
    channel = str(item.channel)
    _once(target, (name, channel), _scalars(item, _WIDTH[channel]))


def film_curves(scene: Scene) -> tuple[FilmCurves, FilmCurves]:
    """Curves of the keys of cameras and of lights, by (name, channel)."""
    out = Curves()
    for item in scene.keys:
        if item.camera is not None or item.light is not None:
            _film(item, scene, out)
    return out.cameras, out.lights


def constant_or_keyed(
    value: Any, times: list[float] | None, curve: str, path: Path_, mistakes: list[Mistake]
) -> Curve | None:
    """Curve of a force item's vector, constant or over time."""
    if value is None:
        return None
    try:
        if times is None:
            return keyed([0.0], [value])
        return keyed(times, value, kind=curve)  # type: ignore[arg-type]
    except PantographError as e:
        mistakes.append(Mistake(path, str(e)))
        return None
