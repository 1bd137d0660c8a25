"""What a rig did: a Recording of its joints, and a report of tracking, timing and packets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...sim.recording import Recording, model_to_bytes
from ..driver import Driver, Statistics
from ..limits import Verdict
from ..mapping import Mapping, indices
from ..rig import Rig
from ..virtual.motor import MOTORS
from .contract import FEEDBACK
from .loop import Log
from .session import Outcome

Array = NDArray[np.float64]
_LONGEST_DELAY = 0.5  # s that is searched


@dataclass(frozen=True)
class Tracking:
    """How one joint followed: rms and greatest error [rad, m], delay [s], rms error with the delay undone."""

    joint: str
    rms: float
    worst: float
    delay: float
    rms_aligned: float
    unit: str = "rad"


@dataclass(frozen=True)
class Timing:
    """How well the schedule was kept over the streaming cycles.

    jitter: begun - due, 50th and 99th percentile and greatest [s]; histogram: (rate [Hz], cycles) of the
    rates between two cycles; busy: median time from goal to feedback [s].
    """

    cycles: int
    skipped: int
    jitter: tuple[float, float, float]
    histogram: tuple[tuple[float, int], ...]
    busy: float


@dataclass(frozen=True)
class MirrorReport:
    """Result of mirroring.

    status: 'done', 'interrupted' or 'fault' (then message, phase and servo say what); stop: how the rig was
    left; unconfirmed: what could not be confirmed while stopping; slowed: how often slower the motion ran;
    t (n,) [s] from the start of the stream, commanded and measured (n, nj): joints of the rig, NaN where no
    answer came; recording: the rig's motion, None when nothing was streamed.
    """

    status: str
    message: str
    phase: str
    servo: int | None
    stop: str
    unconfirmed: tuple[str, ...]
    phases: tuple[tuple[str, float], ...]
    joints: tuple[str, ...]
    t: Array
    commanded: Array
    measured: Array
    tracking: tuple[Tracking, ...]
    timing: Timing | None
    packets: Statistics
    lost_goals: int
    oldest_goal: int
    clamped: int
    hottest: float
    lowest_voltage: float
    notes: tuple[str, ...]
    slowed: float = 1.0
    verdict: Verdict | None = None
    recording: Recording | None = None

    def __str__(self) -> str:
        head = "mirrored" if self.status == "done" else f"{self.status} in phase {self.phase!r}"
        lines = [f"{head}: {self.message}" if self.message else head, f"  stop: {self.stop}"]
        lines += [f"  not confirmed: {u}" for u in self.unconfirmed]
        if self.slowed != 1.0:
            lines.append(f"  ran {self.slowed:.4g} times slower to fit the limits")
        for k in self.tracking:
            lines.append(
                f"  {k.joint}: rms {k.rms:.4f} {k.unit}, worst {k.worst:.4f} {k.unit}, "
                f"delay {k.delay * 1e3:.1f} ms, rms without delay {k.rms_aligned:.4f} {k.unit}"
            )
        if self.timing:
            p50, p99, most = (1e3 * j for j in self.timing.jitter)
            lines.append(
                f"  {self.timing.cycles} cycles, {self.timing.skipped} skipped; jitter {p50:.3f} ms median, "
                f"{p99:.3f} ms 99 %, {most:.3f} ms greatest; busy {self.timing.busy * 1e3:.2f} ms a cycle"
            )
            rates: list[str] = []
            below = 0.0
            for rate, n in self.timing.histogram:
                if n:
                    band = f"up to {rate:.4g}" if np.isfinite(rate) else f"above {below:.4g}"
                    rates.append(f"{band} Hz {n}")
                below = rate
            lines.append(f"  cycles by rate: {', '.join(rates)}")
        s = self.packets
        lines.append(
            f"  packets: {s.sent} sent, {s.received} received, {s.lost} answers lost, {s.corrupt} corrupt, "
            f"{s.retries} retries; {self.lost_goals} goals lost, oldest {self.oldest_goal} cycles"
        )
        return "\n".join(lines + [f"  note: {n}" for n in self.notes])


def make_report(
    outcome: Outcome,
    rig: Rig,
    driver: Driver,
    mapping: Mapping,
    *,
    notes: tuple[str, ...] = (),
    slowed: float = 1.0,
    verdict: Verdict | None = None,
    model: mujoco.MjModel | None = None,
    others: Callable[[Array], Array] | None = None,
    scene: dict[str, Any] | None = None,
) -> MirrorReport:
    """Report of a session; with a `model`, a Recording of the rig.

    `others` gives qpos (n, nq) at times (n,) for what is no joint of the rig; the model's qpos0 without.
    """
    log = outcome.log
    rows = [i for i, p in enumerate(log.phase) if p == "stream"]
    nj = len(mapping.joints)
    begun = np.array([log.begun[i] for i in rows])
    t = begun - begun[0] if len(rows) else np.zeros(0)
    counts = np.array([log.feedback[i] for i in rows], dtype=float)
    feedback = counts.reshape(len(rows), len(rig.ids), len(FEEDBACK))
    if outcome.ready is not None:
        feedback = outcome.ready.block.si(feedback)
    commanded = measured = np.zeros((0, nj))
    tracking: tuple[Tracking, ...] = ()
    recording = None
    if rows:
        commanded = mapping.joint(np.array([log.goal[i] for i in rows]))
        measured = _joints_heard(mapping, feedback[:, :, 0])
        tracking = tuple(
            replace(_track(name, t, commanded[:, j], measured[:, j]), unit=mapping.units[j])
            for j, name in enumerate(mapping.joints)
        )
        if model is not None and np.isfinite(measured).any(axis=0).all():
            recording = _recording(outcome, rig, mapping, model, t, feedback, measured, others, scene or {})
    extra = outcome.ready.changed if outcome.ready else ()
    return MirrorReport(
        status=outcome.status,
        message=outcome.message,
        phase=outcome.phase,
        servo=outcome.servo,
        stop=outcome.stop,
        unconfirmed=tuple(outcome.unconfirmed),
        phases=tuple(outcome.phases),
        joints=mapping.joints,
        t=_frozen(t),
        commanded=_frozen(commanded),
        measured=_frozen(measured),
        tracking=tracking,
        timing=_timing(log, rows),
        packets=driver.statistics,
        lost_goals=log.lost_goals,
        oldest_goal=log.oldest_goal,
        clamped=log.clamped,
        hottest=log.hottest,
        lowest_voltage=log.lowest_voltage,
        notes=(*notes, *(f"EEPROM rewritten: {c}" for c in extra)),
        slowed=slowed,
        verdict=verdict,
        recording=recording,
    )


def _frozen(a: Array) -> Array:
    a.setflags(write=False)
    return a


def _joints_heard(mapping: Mapping, s: Array) -> Array:
    """Joint values of servo angles (n, ns); NaN for a joint one of whose servos was not heard."""
    deaf = np.isnan(s).astype(float) @ np.abs(mapping.inverse.T) > 0
    q = mapping.joint(np.where(np.isnan(s), mapping.zero, s))
    return np.where(deaf, np.nan, q)


def _track(joint: str, t: Array, goal: Array, real: Array) -> Tracking:
    """Error and delay: the shift of the goal that explains the motion best, to a fraction of a sample."""
    heard = np.isfinite(real)
    if not heard.any():
        return Tracking(joint, np.nan, np.nan, np.nan, np.nan)
    t_heard, q = t[heard], real[heard]
    error = q - np.interp(t_heard, t, goal)

    def rms(delay: float) -> float:
        late = t_heard >= t[0] + _LONGEST_DELAY
        use = late if late.sum() > 10 else np.ones_like(late)
        return float(np.sqrt(np.mean((q - np.interp(t_heard - delay, t, goal))[use] ** 2)))

    delay, aligned = 0.0, rms(0.0)
    if np.ptp(goal) > 1e-3 and len(t) > 10:
        step = min(float(np.median(np.diff(t))) / 4, 5e-3)
        shifts = np.arange(0.0, _LONGEST_DELAY, step)
        curve = np.array([rms(d) for d in shifts])
        k = int(np.argmin(curve))
        delay = float(shifts[k])
        if 0 < k < len(shifts) - 1:  # vertex of the parabola through squares of three neighbours
            a, b, c = curve[k - 1 : k + 2] ** 2
            delay += step * 0.5 * (a - c) / (a - 2 * b + c) if a - 2 * b + c > 0 else 0.0
        aligned = rms(delay)
    return Tracking(joint, float(np.sqrt(np.mean(error**2))), float(np.max(np.abs(error))), delay, aligned)


def _timing(log: Log, rows: list[int]) -> Timing | None:
    if len(rows) < 2:
        return None
    due, begun, ended = (np.array([x[i] for i in rows]) for x in (log.due, log.begun, log.ended))
    jitter = begun - due
    rates = 1 / np.maximum(np.diff(begun), 1e-9)
    edges = np.median(rates) * np.array([0.0, 0.4, 0.7, 0.9, 0.95, 0.99, 1.01, 1.05, 1.1, 1.5, np.inf])
    counts, _ = np.histogram(rates, edges)
    upper = [float(e) for e in edges[1:]]
    return Timing(
        cycles=len(rows),
        skipped=log.skipped,
        jitter=(float(np.median(jitter)), float(np.quantile(jitter, 0.99)), float(jitter.max())),
        histogram=tuple((r, int(c)) for r, c in zip(upper, counts, strict=True)),
        busy=float(np.median(ended - begun)),
    )


def _recording(
    outcome: Outcome,
    rig: Rig,
    mapping: Mapping,
    model: mujoco.MjModel,
    t: Array,
    feedback: Array,
    measured: Array,
    others: Callable[[Array], Array] | None,
    scene: dict[str, Any],
) -> Recording:
    qpos, dofs = indices(rig, mapping, model)
    filled = np.stack([np.interp(t, t[np.isfinite(x)], x[np.isfinite(x)]) for x in measured.T], axis=1)
    q = np.tile(model.qpos0, (len(t), 1)) if others is None else np.array(others(t))
    q[:, qpos] = filled
    _follow(model, q, {int(i) for i in qpos})
    v = np.zeros((len(t), model.nv))
    v[:, dofs] = np.nan_to_num(mapping.joint_rates(filled, np.nan_to_num(feedback[:, :, 1])))
    tau = np.zeros_like(v)
    tau[:, dofs] = mapping.joint_force(filled, _servo_torque(rig, np.nan_to_num(feedback[:, :, 2])))
    a = np.gradient(v, t, axis=0) if len(t) > 1 else np.zeros_like(v)
    kinetic, potential = _energies(model, q, v)
    tracked = np.zeros(model.nv, dtype=bool)
    tracked[dofs] = True
    nothing = np.zeros((0, 0))
    return Recording(
        t=t.copy(),
        q=q,
        v=v,
        a=a,
        tau=tau,
        ctrl=np.zeros((len(t), model.nu)),
        kinetic=kinetic,
        potential=potential,
        normal=np.zeros(len(t)),
        goals=(),
        missed=np.zeros((len(t), 0, 2)),
        keyed=np.zeros(model.nv, dtype=bool),
        tracked=tracked,
        tick_t=np.zeros(0),
        tick_ctrl=nothing,
        tick_qfrc=nothing,
        events=(),
        status="done" if outcome.status == "done" else "interrupted",
        message=outcome.message,
        stats={"engine": "rig", "rig": rig.name, "rate": rig.rate, "cycles": len(t)},
        notes=(f"measured by the servos of {rig.name}; other joints as they were commanded",),
        scene=scene,
        versions={
            "pantograph": version("pantograph-sim"),
            "mujoco": mujoco.__version__,
            "numpy": np.__version__,
        },
        model_bytes=model_to_bytes(model),
    )


def _follow(model: mujoco.MjModel, q: Array, driven: set[int]) -> None:
    """Joints that an equality ties to a driven one (the other finger of a gripper) go along with it.

    MuJoCo, equality/joint: y - y0 = sum c_k (x - x0)^k, joint1 is y, joint2 is x.
    """
    for e in range(model.neq):
        if model.eq_type[e] != mujoco.mjtEq.mjEQ_JOINT or model.eq_obj2id[e] < 0:
            continue
        y, x = (int(model.jnt_qposadr[j]) for j in (model.eq_obj1id[e], model.eq_obj2id[e]))
        c = model.eq_data[e, :5]
        if x in driven and y not in driven:
            q[:, y] = model.qpos0[y] + np.polyval(c[::-1], q[:, x] - model.qpos0[x])
        elif y in driven and x not in driven and c[1] != 0 and not c[2:].any():
            q[:, x] = model.qpos0[x] + (q[:, y] - model.qpos0[y] - c[0]) / c[1]


def _servo_torque(rig: Rig, load: Array) -> Array:
    """Output torque (n, ns) [N m] of measured currents [A], or of loads as a part of the stall torque."""
    from ..registers import control_table

    factor = []
    for s in rig.servos:
        table = control_table(s.model)
        motor = MOTORS[table.model]
        factor.append(motor.kt if table.has_current else motor.stall_torque)
    return np.asarray(load * np.array(factor), dtype=float)


def _energies(model: mujoco.MjModel, q: Array, v: Array) -> tuple[Array, Array]:
    data = mujoco.MjData(model)
    kinetic, potential = np.zeros(len(q)), np.zeros(len(q))
    for i in range(len(q)):
        data.qpos[:], data.qvel[:] = q[i], v[i]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        potential[i], kinetic[i] = data.energy
    return kinetic, potential
