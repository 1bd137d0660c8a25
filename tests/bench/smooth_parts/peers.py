"""Pinocchio and Drake beside the smooth engine: the same joints written out, run in their own processes."""

import shutil
import subprocess
from pathlib import Path

import mujoco
import numpy as np
from figures import ENVIRONMENTS, environment, last_line

VENV, DRAKE = ENVIRONMENTS / "pinocchio", ENVIRONMENTS / "drake"
SOURCE = Path(__file__).resolve().parents[1] / "peers" / "pinocchio.cpp"
FLAGS = "-std=c++17 -O3 -march=native -DNDEBUG"
FLAGS += " -DBOOST_MPL_LIMIT_LIST_SIZE=30 -DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS"  # as its CMake files


def program():
    """The compiled timing program; a sentence saying why not when it cannot be had."""
    binary = VENV / "timing"
    if binary.exists() and binary.stat().st_mtime > SOURCE.stat().st_mtime:
        return binary
    if shutil.which("g++") is None:
        return "absent: timing Pinocchio without Python takes a C++ compiler (g++), which is not here"
    if isinstance(python := environment("pinocchio", "pin"), str):
        return python
    prefix = next(VENV.glob("lib/python*/site-packages/cmeel.prefix"), None)
    import casadi

    eigen = Path(casadi.__file__).parent / "include" / "eigen3"  # CasADi's package carries Eigen's headers
    command = ["g++", *FLAGS.split(), f"-I{prefix}/include", f"-I{eigen}", SOURCE, "-o", binary]
    here = f"$ORIGIN/{prefix.relative_to(VENV)}/lib"
    command += [f"-L{prefix}/lib", "-lpinocchio_default", f"-Wl,-rpath,{here}"]
    print("compiling Pinocchio's timing program, once: a few minutes ...", flush=True)
    built = subprocess.run(command, capture_output=True, text=True)
    return binary if built.returncode == 0 else f"absent: {built.stderr.splitlines()[0][:200]}"


def _turn(quat):
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, np.asarray(quat, float))
    return R.reshape(3, 3)


def _z_along(axis):
    a = axis / np.linalg.norm(axis)
    x = np.eye(3)[(int(np.argmax(np.abs(a))) + 1) % 3]
    x = x - a * (a @ x)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(a, x), a])


def _pose(R, p):
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, p
    return X


def joints_of(model):
    """(parent, kind, placement, mass, com, inertia about it) of every joint; hinges and slides along z."""
    rows, frame = [], {0: (0, np.eye(4))}
    for b in range(1, model.nbody):
        parent, X = frame[model.body_parentid[b]]
        X = X @ _pose(_turn(model.body_quat[b]), model.body_pos[b])
        for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
            kind = ("free", "ball", "slide", "hinge")[model.jnt_type[j]]
            A = np.eye(4)
            if kind == "free":
                X = np.eye(4)
            else:
                R = _z_along(model.jnt_axis[j]) if kind in ("slide", "hinge") else np.eye(3)
                A = _pose(R, model.jnt_pos[j])
            rows.append([parent, kind, X @ A, 0.0, np.zeros(3), np.zeros((3, 3))])
            parent, X = len(rows), np.linalg.inv(A)
        frame[b] = parent, X
        if parent:
            _add_body(rows[parent - 1], model, b, X)
    return rows


def _add_body(row, model, b, X):
    m, R = model.body_mass[b], X[:3, :3] @ _turn(model.body_iquat[b])
    c = X[:3, :3] @ model.body_ipos[b] + X[:3, 3]
    inertia = R @ np.diag(model.body_inertia[b]) @ R.T
    total = row[3] + m
    if total > 0:
        mean = (row[3] * row[4] + m * c) / total
        for mass, place in ((row[3], row[4]), (m, c)):
            d = place - mean
            inertia = inertia + mass * (d @ d * np.eye(3) - np.outer(d, d))
        row[3], row[4], row[5] = total, mean, row[5] + inertia


def _vectors(model, q, v, tau):
    """State and force in Pinocchio's order and frames."""
    q, v, tau = q.copy(), v.copy(), tau.copy()
    for j in range(model.njnt):
        at, dof, kind = model.jnt_qposadr[j], model.jnt_dofadr[j], model.jnt_type[j]
        if kind == 0:
            R = _turn(q[at + 3 : at + 7])
            v[dof : dof + 3], tau[dof : dof + 3] = R.T @ v[dof : dof + 3], R.T @ tau[dof : dof + 3]
            at += 3
        if kind in (0, 1):
            q[at : at + 4] = np.roll(q[at : at + 4], -1)
    return q, v, tau


def _acceleration(model, q, v, a):
    """Accelerations back in MuJoCo's frames."""
    a = a.copy()
    for j in np.flatnonzero(model.jnt_type == 0):
        at, dof = model.jnt_qposadr[j], model.jnt_dofadr[j]
        R = _turn(q[at + 3 : at + 7])
        w = v[dof + 3 : dof + 6]
        a[dof : dof + 3] = R @ (a[dof : dof + 3] + np.cross(w, R.T @ v[dof : dof + 3]))
    return a


class Pinocchio:
    """Its timing program on a model's states; `binary` is what `program` gave."""

    def __init__(self, binary, model, q, v, tau):
        self.binary, self.model, self.q, self.v = binary, model, q, v
        rows = joints_of(model)
        lines = [f"{len(rows)} {len(q)}", " ".join(map(repr, model.opt.gravity.tolist()))]
        for parent, kind, X, m, c, inertia in rows:
            numbers = [*X[:3, :3].ravel(), *X[:3, 3], m, *c, *inertia.ravel()]
            lines.append(f"{parent} {kind} " + " ".join(repr(float(x)) for x in numbers))
        for state in zip(q, v, tau, strict=True):
            lines.append(" ".join(repr(float(x)) for part in _vectors(model, *state) for x in part))
        self.path = VENV / "model.txt"
        self.path.write_text("\n".join(lines))

    def _lines(self, *options):
        command = [self.binary, self.path, *options]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()

    def seconds(self):
        """CPU seconds of a forward dynamics and of its derivatives, each a median."""
        return [float(line.split()[1]) * 1e-9 for line in self._lines("time")]

    def accelerations(self):
        """Of all states, in MuJoCo's frames."""
        rows = zip(self.q, self.v, self._lines("accelerations"), strict=True)
        return np.array([_acceleration(self.model, x, y, np.array(row.split(), float)) for x, y, row in rows])


def drake_python():
    """The Python that has Drake; a sentence saying why not when it cannot be had or does not start."""
    if isinstance(python := environment("drake", "drake"), str):
        return python
    command = [python, "-c", "import pydrake.multibody.plant"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return f"absent: {last_line(done.stderr)}" if done.returncode else python


def _mjcf(model):
    """The model as MJCF with one body a joint: welded bodies lumped, hinges and slides along z."""
    rows = joints_of(model)

    def body(i):
        _, kind, X, m, c, inertia = rows[i]
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, X[:3, :3].ravel())
        matter = ""
        if m > 0:
            six = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
            matter = f'<inertial mass="{float(m)!r}" pos="{_words(c)}" fullinertia="{_words(six)}"/>'
        inner = "".join(body(k) for k, row in enumerate(rows) if row[0] == i + 1)
        place = f'pos="{_words(X[:3, 3])}" quat="{_words(quat)}"'
        return f'<body {place}><joint type="{kind}" axis="0 0 1"/>{matter}{inner}</body>'

    text = "".join(body(i) for i, row in enumerate(rows) if row[0] == 0)
    gravity = f'<option gravity="{_words(model.opt.gravity)}"/>'
    return f'<mujoco model="stripped">{gravity}<worldbody>{text}</worldbody></mujoco>'


def _words(numbers):
    return " ".join(repr(float(x)) for x in numbers)


class Drake:
    """Its forward dynamics on a model's states, by the Python that `drake_python` gave.

    Drake's free joints: quaternion before position, turning before moving, both in the world.
    """

    def __init__(self, python, model, q, v, tau):
        self.model, self.free = model, np.flatnonzero(model.jnt_type == 0)
        self.turns = {
            j: [_turn(x[k + 3 : k + 7]) for x in q] for j in self.free for k in [model.jnt_qposadr[j]]
        }
        q, v, tau = q.copy(), v.copy(), tau.copy()
        for j in self.free:
            at, dof = model.jnt_qposadr[j], model.jnt_dofadr[j]
            q[:, at : at + 7] = np.roll(q[:, at : at + 7], 4, axis=1)
            for x in (v, tau):
                turned = np.einsum("nij,nj->ni", self.turns[j], x[:, dof + 3 : dof + 6])
                x[:, dof : dof + 6] = np.hstack([turned, x[:, dof : dof + 3]])
        path, given, self.result = (DRAKE / name for name in ("model.xml", "states.npz", "result.npz"))
        path.write_text(_mjcf(model))
        np.savez(given, q=q, v=v, tau=tau)
        self.command = [python, SOURCE.parent / "drake_aba.py", path, given, self.result]

    def run(self):
        """CPU seconds of a forward dynamics and of the calls taken off, and accelerations; or why not."""
        done = subprocess.run(self.command, capture_output=True, text=True)
        if done.returncode:
            return f"absent: {last_line(done.stderr)}"
        got = np.load(self.result)
        a = got["a"].copy()
        for j in self.free:
            dof = self.model.jnt_dofadr[j]
            turned = np.einsum("nji,nj->ni", self.turns[j], a[:, dof : dof + 3])
            a[:, dof : dof + 6] = np.hstack([a[:, dof + 3 : dof + 6], turned])
        return float(got["seconds"]), float(got["call_seconds"]), a
