"""Motion captures of the data folder: BVH files as models of ball joints with their motion, z up, metres."""

from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from pantograph.models import data_robots
from scipy.spatial.transform import Rotation

FEET = {"fb": ("RightToeBase", "LeftToeBase"), "mb": ("LeftAnkle", "RightAnkle")}  # bodies that stand
_UP = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # y is up in the files
_FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky", "Eye")


class Capture(NamedTuple):
    """A model, times t (k,), its motion q (k, nq), and when which foot stands."""

    model: mujoco.MjModel
    t: np.ndarray
    q: np.ndarray
    stances: dict[str, list[tuple[float, float]]]


def folder() -> Path | None:
    """Where the captures are; None without the data folder."""
    found = next((p.parents[2] / "mocap" for p in data_robots().values()), None)
    return found if found is not None and found.is_dir() else None


def capture(name: str) -> Capture:
    """One of `FEET`, whose feet stand where they are low and slow."""
    path = folder()
    assert path is not None
    model, t, q = _read(path / f"{name}.bvh")
    stances = {f"body:{foot}": _stances(model, t, q, foot) for foot in FEET[name]}
    return Capture(model, t, q, stances)


def _stances(model, t, q, foot, *, speed=0.35, height=0.03, least=0.12):
    data, p = mujoco.MjData(model), np.empty((len(t), 3))
    for k, x in enumerate(q):
        data.qpos[:] = x
        mujoco.mj_kinematics(model, data)
        p[k] = data.body(foot).xpos
    slow = np.linalg.norm(np.gradient(p, t, axis=0), axis=1) < speed
    on = slow & (p[:, 2] < p[:, 2].min() + height)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int))).reshape(-1, 2)
    return [(float(t[i]), float(t[j - 1])) for i, j in edges if t[j - 1] - t[i] >= least]


def _read(path):
    head, _, tail = path.read_text().partition("MOTION")
    lines = [line.split() for line in tail.strip().splitlines()]
    dt, rows = float(lines[1][-1]), np.array(lines[2:], dtype=float)
    spec = mujoco.MjSpec()
    bodies, joints, column = [spec.worldbody], [], 0
    for line in map(str.split, head.splitlines()):
        if line[0] in ("ROOT", "JOINT"):
            name = line[1].split(":")[-1]
            left_out = bodies[-1] is None or any(word in name for word in _FINGERS)
            bodies.append(None if left_out else bodies[-1].add_body(name=name))
        elif line[0] == "End":
            bodies.append(None)
        elif line[0] == "}":
            bodies.pop()
        elif line[0] == "OFFSET" and bodies[-1] is not None and len(bodies) > 2:
            bodies[-1].pos = 0.01 * np.array(line[1:], dtype=float)
        elif line[0] == "CHANNELS":
            count, root = int(line[1]), len(bodies) == 2
            if bodies[-1] is not None:
                kind = mujoco.mjtJoint.mjJNT_FREE if root else mujoco.mjtJoint.mjJNT_BALL
                bodies[-1].add_joint(name=bodies[-1].name, type=kind)
                bodies[-1].add_geom(size=[0.04, 0, 0])
                axes = "".join(word[0] for word in line[-3:])
                joints.append((bodies[-1].name, root, axes, column))
            column += count
    model = spec.compile()
    q = np.zeros((len(rows), model.nq))
    for name, root, axes, at in joints:
        i, turned = int(model.joint(name).qposadr[0]), at + 3 * root
        turns = Rotation.from_euler(axes, rows[:, turned : turned + 3], degrees=True)
        if root:
            q[:, i : i + 3] = _UP.apply(0.01 * rows[:, at : at + 3])
            i, turns = i + 3, _UP * turns
        q[:, i : i + 4] = turns.as_quat(scalar_first=True)
    return model, dt * np.arange(len(rows)), q
