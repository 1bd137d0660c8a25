"""The one currency after a run: what moved, how it was computed, and all that is needed to show it later."""

from __future__ import annotations

import io
import json
import struct
import tempfile
import uuid
import zipfile
import zlib
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from .engines.interface import Event
from .errors import RecordingError

Array = NDArray[np.float64]

MAGIC = "pantograph recording"
VERSION = 1

# what readers of zip, deflate and npy raise on bytes that make no sense
_TORN = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    ValueError,
    KeyError,
    NotImplementedError,
    RuntimeError,
    MemoryError,
)


@dataclass(frozen=True)
class ErrorEstimate:
    """Estimated error of a run, from a second run at half the step with the same control samples.

    angle (n,): largest over rotations [rad]; length (n,): largest over translations [m], at the samples;
    order assumed; trusted_until [s]: first event (contact, limit), after which the order is not known;
    wall_s and evaluations: what the estimate cost, beside the run's own.
    """

    angle: Array
    length: Array
    order: int
    trusted_until: float
    wall_s: float
    evaluations: int


@dataclass(frozen=True)
class Recording:
    """Motion of a scene at n sample times, with everything needed to film, plot, export or mirror it.

    t (n,) [s]; q (n, nq), v (n, nv), a (n, nv) in MuJoCo's coordinates [m, rad]; tau (n, nv) drive
    forces [N, N m]; ctrl (n, nu); kinetic, potential (n,) [J]; normal (n,) sum of contact normal forces
    [N]; keyed, tracked (nv,) masks; tick_t (m,), tick_ctrl (m, nu), tick_qfrc (m, nv): the controller's
    samples, held in between; missed (n, goals, 2): distance [m] and angle [rad] from each of ``goals``.
    ``status`` is 'done', 'diverged', 'interrupted' or 'failed'. Arrays are read-only.
    """

    t: Array
    q: Array
    v: Array
    a: Array
    tau: Array
    ctrl: Array
    kinetic: Array
    potential: Array
    normal: Array
    goals: tuple[str, ...]
    missed: Array
    keyed: NDArray[np.bool_]
    tracked: NDArray[np.bool_]
    tick_t: Array
    tick_ctrl: Array
    tick_qfrc: Array
    events: tuple[Event, ...]
    status: str
    message: str
    stats: dict[str, Any]
    notes: tuple[str, ...]
    scene: dict[str, Any]
    versions: dict[str, str]
    model_bytes: bytes = field(repr=False)
    error: ErrorEstimate | None = None

    def __post_init__(self) -> None:
        for owner in (self, self.error):
            for f in fields(owner) if owner is not None else ():
                value = getattr(owner, f.name)
                if isinstance(value, np.ndarray):
                    value.setflags(write=False)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model of the run. Raises RecordingError when another MuJoCo made it."""
        made = self.versions.get("mujoco", "unknown")
        if made != mujoco.__version__:
            raise RecordingError(
                f"this recording holds a model of MuJoCo {made}, here is {mujoco.__version__}: "
                "its arrays can be read, but filming it needs that version; or run its scene again"
            )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "model.mjb"
            path.write_bytes(self.model_bytes)
            return mujoco.MjModel.from_binary_path(str(path))

    @property
    def energy(self) -> Array:
        """Total energy (n,) [J]."""
        return self.kinetic + self.potential

    def save(self, path: str | Path) -> Path:
        """Write the recording to one file; whole or not at all. Raises RecordingError if it cannot."""
        path = Path(path)
        if path.is_dir():
            raise RecordingError(f"cannot write {path}: it is a folder; name a file in it")
        arrays, header = _pack(self)
        header |= {"magic": MAGIC, "version": VERSION}
        temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with temporary.open("xb") as f:
                np.savez_compressed(
                    f,
                    allow_pickle=False,
                    header=np.frombuffer(json.dumps(header).encode(), dtype=np.uint8),
                    model_bytes=np.frombuffer(self.model_bytes, dtype=np.uint8),
                    **arrays,
                )
            temporary.replace(path)
        except OSError as e:
            raise RecordingError(f"cannot write {path}: {e.strerror or e}") from None
        finally:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
        return path


def check_writable(folder: Path) -> None:
    """Raise RecordingError when no recording can be saved in a folder, before work is spent on one."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as e:
        raise RecordingError(f"cannot write into {folder}: {e.strerror}; name another folder") from None


def load(path: str | Path) -> Recording:
    """The recording in a file, bit for bit as it was saved.

    Raises RecordingError for a missing, torn or foreign file, or one of a later version.
    """
    path = Path(path)
    try:
        raw = path.read_bytes()
    except FileNotFoundError:
        near = ", ".join(sorted(p.name for p in path.parent.glob("*.npz"))) or "none"
        raise RecordingError(f"no recording {path}; recordings in {path.parent}: {near}") from None
    except OSError as e:
        raise RecordingError(f"cannot read {path}: {e.strerror}") from None
    if raw[:2] != b"PK":
        raise RecordingError(f"{path} is not a recording; recordings are .npz files made by 'pantograph run'")
    try:
        with np.load(io.BytesIO(raw), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except _TORN as e:
        raise RecordingError(f"{path} is torn: {e}; run its scene again") from None
    try:
        header = json.loads(arrays.pop("header").tobytes())
    except (KeyError, ValueError):
        header = {}
    if not isinstance(header, dict) or header.get("magic") != MAGIC:
        raise RecordingError(f"{path} is a .npz file, but no recording of Pantograph")
    version = header.get("version")
    if version != VERSION:
        raise RecordingError(f"{path} is of format {version}; this Pantograph reads {VERSION}: update it")
    try:
        return _unpack(arrays, header)
    except (KeyError, TypeError, AttributeError, ValueError) as e:
        raise RecordingError(f"{path} lacks a part of a recording: {e}") from None


def _pack(recording: Recording) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    arrays: dict[str, NDArray[Any]] = {}
    header: dict[str, Any] = {}
    for f in fields(Recording):
        value = getattr(recording, f.name)
        if isinstance(value, np.ndarray):
            arrays[f.name] = value
        elif f.name == "events":
            header["events"] = [[e.t, e.kind, e.what] for e in value]
        elif f.name == "error" and value is not None:
            arrays |= {"error_angle": value.angle, "error_length": value.length}
            scalars = ("order", "trusted_until", "wall_s", "evaluations")
            header["error"] = {name: getattr(value, name) for name in scalars}
        elif f.name not in ("model_bytes", "error"):
            header[f.name] = value
    return arrays, header


def _unpack(arrays: dict[str, NDArray[Any]], header: dict[str, Any]) -> Recording:
    header = {k: v for k, v in header.items() if k not in ("magic", "version")}
    model_bytes = arrays.pop("model_bytes").tobytes()
    error = header.pop("error", None)
    if error is not None:
        error = ErrorEstimate(angle=arrays.pop("error_angle"), length=arrays.pop("error_length"), **error)
    header["events"] = tuple(Event(*e) for e in header["events"])
    header["notes"], header["goals"] = tuple(header["notes"]), tuple(header["goals"])
    parts: dict[str, Any] = {**arrays, **header}
    return Recording(**parts, model_bytes=model_bytes, error=error)


def model_to_bytes(model: mujoco.MjModel) -> bytes:
    """The compiled model as MuJoCo's binary format."""
    buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()
