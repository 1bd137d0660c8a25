"""A motion as keys of a scene: tables [[keys]] whose curves are the motion, to a stated error."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...sim.clip import Clip, FreeTrack, Track
from ...sim.curves import Curve, keyed
from ...sim.kinds import HINGE
from ...sim.rotation_curves import RotationCurve, keyed_rotation
from ..nominal import difference

Array = NDArray[np.float64]
_CLOSE = 1e-4  # rad, m
_RATE, _ROUNDS = 25, 6  # keys a second at first, and how often they are doubled at most


class Keys(NamedTuple):
    """Tables [[keys]] as TOML, and how far [rad, m] their motion is from the one that they are of."""

    text: str
    error: float
    rows: int


def as_keys(clip: Clip, *, degree: bool = False) -> Keys:
    """A clip as keys of a scene, hinges in radians or in degrees: as many as keep it within 1e-4 rad or m."""
    fine = np.linspace(clip.start, clip.end, 4001)
    wanted, rate = clip.evaluate(fine, left=True), _RATE
    kind = "clamped" if max(np.abs(wanted.v[k]).max() for k in (0, -1)) <= 1e-9 else "natural"
    for _ in range(_ROUNDS):
        count = max(2, int(np.ceil((clip.end - clip.start) * rate)) + 1)
        times = np.round(np.linspace(clip.start, clip.end, count), 9)
        tracks = {name: _track(track, times, kind) for name, track in clip.tracks.items()}
        found = Clip(clip.model, tracks, clip.q0).evaluate(fine, left=True).q
        rows = zip(wanted.q, found, strict=True)
        error = max(float(np.abs(difference(clip.model, *row)).max(initial=0.0)) for row in rows)
        if error <= _CLOSE:
            break
        rate *= 2
    tables = [_table(clip, name, *part, kind, degree) for name, t in tracks.items() for part in _parts(t)]
    return Keys("\n".join(tables), error, count)


def _track(track: Track, times: Array, kind: Any) -> Track:
    """A track through points of another."""
    if isinstance(track, FreeTrack):
        position, rotation = (
            None if c is None else _track(c, times, kind) for c in (track.position, track.rotation)
        )
        return FreeTrack(position, rotation)  # type: ignore[arg-type]
    rows = np.round(track(times, left=True)[0], 10)
    if isinstance(track, RotationCurve):
        return keyed_rotation(times, rows, kind=kind)
    return keyed(times, rows, kind=kind)


def _parts(track: Track) -> Iterator[tuple[str, Curve]]:
    """Channels of a track, "" where it has but one."""
    if not isinstance(track, FreeTrack):
        yield "", track
        return
    if track.position is not None:
        yield "position", track.position
    if track.rotation is not None:
        yield "rotation", track.rotation


def _table(clip: Clip, name: str, channel: str, curve: Curve, kind: str, degree: bool) -> str:
    turns = degree and int(clip.model.joint(name).type[0]) == HINGE
    rows = np.round(np.rad2deg(curve.values) if turns else curve.values, 10).tolist()
    values = [row[0] for row in rows] if len(rows[0]) == 1 else rows
    lines = ["[[keys]]", f"joint = {json.dumps(name)}", f'channel = "{channel}"' if channel else ""]
    lines += [f"times = {curve.times.tolist()}", f"values = {values}", f'curve = "{kind}"']
    return "\n".join(line for line in lines if line) + "\n"
