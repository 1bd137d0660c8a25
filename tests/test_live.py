"""A simulation beside the rig that follows it: its process always ends, and what it says is never garbled."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys

import numpy as np
import pytest
from pantograph.hardware.errors import HardwareError, SourceFault
from pantograph.hardware.mapping import make_mapping
from pantograph.hardware.mirror import live as module
from pantograph.hardware.mirror import mirror_live
from pantograph.hardware.mirror.live import Live
from pantograph.hardware.rig import RigError, parse_rig
from pantograph.hardware.virtual_rig import virtual_bus
from pantograph.sim.plan import make_plan
from pantograph.sim.run import run
from pantograph.sim.scene.schema import Scene
from test_servo_faults import RIG

MODEL = """<mujoco><worldbody>
  <body><joint name="elbow" axis="0 1 0" {elbow}/><geom size="0.02" pos="0 0 -.1" mass="0.1"/>
    <body pos="0 0 -.2"><joint name="wrist" axis="0 1 0"/><geom size="0.02" pos="0 0 -.1" mass="0.05"/></body>
  </body></worldbody></mujoco>"""


def make_scene(tmp_path, elbow: str = 'damping="0.01"', **more) -> Scene:
    path = tmp_path / "arm.xml"
    path.write_text(MODEL.format(elbow=elbow))
    start = {"position": {"elbow": 0.1, "wrist": -0.1}}
    return Scene(**({"duration": 60.0, "models": [{"file": str(path)}], "initial": start} | more))


def make_live(scene: Scene, **more) -> Live:
    rig = parse_rig(RIG)
    return Live(make_plan(scene), rig, make_mapping(rig), **({"patient": True} | more))


@pytest.fixture
def started(monkeypatch) -> list[subprocess.Popen]:
    """Processes that were started, the program of the next ones being `started.program` if that is set."""

    class Started(list):
        program = ""

    processes, real = Started(), subprocess.Popen

    def popen(words, **options):
        words = [sys.executable, "-c", processes.program] if processes.program else words
        processes.append(real(words, **options))
        return processes[-1]

    monkeypatch.setattr(module.subprocess, "Popen", popen)
    return processes


def is_gone(process: subprocess.Popen) -> bool:
    """Whether a process has ended and was waited for: its number is free."""
    try:
        os.kill(process.pid, 0)
    except ProcessLookupError:
        return process.returncode is not None
    return False


DIVERGES = 'stiffness="-1e7"'
BROKEN = [
    ("raise SystemExit(3)", "exit status 3"),
    ("import os; os.kill(os.getpid(), 9)", "signal 9"),
    ("print('hello', flush=True); import time; time.sleep(60)", "what its process sends is no motion"),
]


@pytest.mark.parametrize(("program", "says"), BROKEN)
def test_a_simulation_that_does_not_start_says_why_and_leaves_no_process(tmp_path, started, program, says):
    started.program = program
    simulation = make_live(make_scene(tmp_path))
    with pytest.raises(HardwareError, match=f"the simulation did not start: .*{says}"), simulation:
        raise AssertionError("it must not start")
    assert is_gone(started[0])
    assert not simulation._thread.is_alive()


def test_one_whose_physics_fails_at_once_leaves_no_process_either(tmp_path, started):
    bus = virtual_bus(parse_rig(RIG))
    with pytest.raises(HardwareError, match=r"the simulation did not start: .*diverged at t = "):
        mirror_live(make_scene(tmp_path, DIVERGES), parse_rig(RIG), bus=bus)
    assert is_gone(started[0])
    assert not any(s.get("torque_enable") for s in bus.servos)


def test_one_that_is_interrupted_while_it_starts_leaves_no_process(tmp_path, started, monkeypatch):
    def interrupted(self, **_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Live, "_take", interrupted)
    with pytest.raises(KeyboardInterrupt), make_live(make_scene(tmp_path)):
        raise AssertionError("it must not start")
    assert is_gone(started[0])


TORN = """
import pickle, sys, numpy as np
t = np.linspace(0.0, 0.5, 26)
pickle.dump((t, np.zeros((26, 2)), np.zeros((26, 2))), sys.stdout.buffer)
sys.stdout.buffer.write(pickle.dumps((t, np.zeros((26, 2)), np.zeros((26, 2))))[:{count}])
"""


@pytest.mark.parametrize("count", [1, 2, 30, 400])
def test_a_torn_window_is_told_and_the_motion_before_it_kept(tmp_path, started, count):
    started.program = TORN.format(count=count)
    with make_live(make_scene(tmp_path)) as simulation:
        assert simulation.at(0.5) is not None
        with pytest.raises(SourceFault, match=r"stopped at t = 0.500 s: .*exit status 0"):
            simulation.at(0.6)
        assert len(simulation.whole(np.linspace(0, 0.5, 7))) == 7
    assert is_gone(started[0])


@pytest.mark.parametrize(("stop", "torque", "says"), [("hold", 1, "holds"), ("park", 0, "parked, then limp")])
def test_a_simulation_that_dies_under_way_stops_the_rig_and_keeps_the_record(
    tmp_path, started, stop, torque, says
):
    """The servos are sound: the promised stop is possible."""
    rig = parse_rig(RIG)
    bus = virtual_bus(rig)

    def kill(t: float) -> None:
        if t > 0.5 and started[0].poll() is None:
            started[0].send_signal(signal.SIGKILL)

    report = mirror_live(make_scene(tmp_path), rig, bus=bus, stop=stop, progress=kill)
    assert report.status == "fault"
    assert "the simulation stopped at t = " in report.message
    assert "signal 9" in report.message
    assert report.stop.startswith(says)
    assert [s.get("torque_enable") for s in bus.servos] == [torque] * 3
    assert 0.5 < report.t[-1] < 30
    assert len(report.recording.t) == len(report.t)
    assert is_gone(started[0])


def test_a_rig_that_does_not_fit_is_refused_before_anything_starts(tmp_path, started):
    rig = parse_rig(RIG.replace('joint = "wrist"', 'joint = "rist"'))
    with pytest.raises(RigError, match="no joint 'rist'"):
        mirror_live(make_scene(tmp_path), rig)
    assert not started


LOUD = """
import os
from pantograph.hardware.mirror import windows as module
quiet = module.windows
def loud(plan):
    for window in quiet(plan):
        print("a law prints")
        os.write(1, b"a library prints\\n")
        yield window
module.windows = loud
module.main()
"""


def test_prints_do_not_get_between_the_windows(tmp_path):
    scene = make_scene(tmp_path, duration=0.5)
    process = subprocess.run(
        [sys.executable, "-c", LOUD], input=pickle.dumps(scene), capture_output=True, timeout=60, check=True
    )
    stream, t = memoryview(process.stdout), []
    while (window := pickle.loads(stream)) is not None:
        t += list(window[0][bool(t) :])
        stream = stream[len(pickle.dumps(window)) :]
    np.testing.assert_allclose(t, run(scene).t)
    assert process.stderr.count(b"a law prints") == process.stderr.count(b"a library prints") >= 5
