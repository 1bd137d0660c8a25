"""Mirroring of a recording, and of a simulation while it runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...sim.plan import Plan, make_plan
from ...sim.recording import Recording, load
from ...sim.scene.schema import Scene
from ..connect import connect
from ..limits import Verdict, check_motion, fit
from ..mapping import joint_bounds, make_bounds, make_mapping
from ..motion import Motion, loads_of, motion_of
from ..rig import VIRTUAL, Rig, Stop, check_model, load_rig
from ..virtual import VirtualBus
from .live import Live
from .record import MirrorReport, make_report
from .session import Session

Array = NDArray[np.float64]
Progress = Callable[[float], None]


def judge(recording: Recording, rig: Rig) -> tuple[Motion, Verdict]:
    """The rig's part of a recording, and whether the rig can make it; RigError when they do not fit."""
    model = recording.model
    check_model(rig, model)
    mapping = make_mapping(rig)
    motion = motion_of(recording, rig, mapping)
    loads = loads_of(recording, rig, mapping)
    return motion, check_motion(motion, mapping, make_bounds(rig), joint_bounds(rig, model), loads)


def mirror_recording(
    recording: Recording | str | Path,
    rig: Rig | str | Path,
    *,
    slow: bool = False,
    stop: Stop = "hold",
    port: str | None = None,
    bus: VirtualBus | None = None,
    paced: bool = False,
    take_over: bool = False,
    progress: Progress | None = None,
    on_phase: Callable[[str], None] | None = None,
) -> MirrorReport:
    """Play a recording on a rig: judge it, then the safety contract, then stream it, then stop.

    ``slow`` slows the motion uniformly until it fits; ``port`` replaces the rig's ('virtual': servos in
    memory, with ``paced`` as slow as real ones); ``bus`` are virtual servos of one's own. ``progress`` is
    told the played time [s]. A fault or Ctrl-C during the motion ends in a report with that status.
    Raises MotionRefused (with a verdict per joint) before anything moves, RigError for a rig that does not
    fit."""
    recording = load(recording) if isinstance(recording, str | Path) else recording
    rig = load_rig(rig) if isinstance(rig, str | Path) else rig
    motion, verdict = judge(recording, rig)
    motion = fit(motion, verdict, slow=slow)
    driver, note = connect(rig, port=port, bus=bus, paced=paced)
    try:
        session = Session(
            rig, driver, stop=stop, take_over=take_over, on_phase=on_phase, model=recording.model
        )
        mapping, begin = session.mapping, float(motion.t[0])

        def target(t: float) -> Array:
            if progress:
                progress(t)
            return mapping.servo(motion.at(begin + t)[0])

        outcome = session.run(target(0.0), target, motion.duration)
    finally:
        driver.close()

    def others(t: Array) -> Array:
        at = recording.t[0] + t / motion.slowed
        return np.asarray(recording.q[np.clip(np.searchsorted(recording.t, at), 0, len(recording.t) - 1)])

    return make_report(
        outcome,
        rig,
        driver,
        mapping,
        notes=(note,),
        slowed=motion.slowed,
        verdict=verdict,
        model=recording.model,
        others=others,
        scene=recording.scene,
    )


def mirror_live(
    scene: Scene | Plan | str | Path,
    rig: Rig | str | Path,
    *,
    stop: Stop = "hold",
    port: str | None = None,
    bus: VirtualBus | None = None,
    paced: bool = False,
    take_over: bool = False,
    progress: Progress | None = None,
    on_phase: Callable[[str], None] | None = None,
) -> MirrorReport:
    """Follow a simulation while it runs; see `mirror_recording` for the arguments.

    What comes is not known beforehand: goals are kept within ranges and speeds cycle by cycle, and the report
    says how many were changed. A simulation that falls behind holds the rig where it is (report: notes).
    """
    rig = load_rig(rig) if isinstance(rig, str | Path) else rig
    mapping = make_mapping(rig)
    virtual = bus is not None or (port or rig.port) == VIRTUAL
    plan = scene if isinstance(scene, Plan) else make_plan(scene)
    check_model(rig, plan.problem.model)
    with Live(plan, rig, mapping, patient=virtual and not paced) as live:
        driver, note = connect(rig, port=port, bus=bus, paced=paced)
        try:
            session = Session(
                rig, driver, stop=stop, take_over=take_over, on_phase=on_phase, model=live.model
            )

            def target(t: float) -> Array | None:
                if progress:
                    progress(t)
                q = live.at(t)
                return None if q is None else mapping.servo(q)

            outcome = session.run(mapping.servo(live.first), target, live.duration)
        finally:
            driver.close()
        notes = (note, *live.notes)
        return make_report(
            outcome,
            rig,
            driver,
            mapping,
            notes=notes,
            model=live.model,
            others=live.whole,
            scene=live.scene,
        )
