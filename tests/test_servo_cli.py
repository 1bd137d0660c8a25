"""The servo commands, calibration by hand, and a mirror process that is really killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np
import pytest
from pantograph.hardware.calibrate import calibrate, rig_text
from pantograph.hardware.cli import app, play_recording
from pantograph.hardware.driver import Driver
from pantograph.hardware.errors import HardwareError
from pantograph.hardware.limits import MotionRefused
from pantograph.hardware.mapping import make_mapping
from pantograph.hardware.ports import open_port
from pantograph.hardware.rig import check_model, parse_rig
from pantograph.hardware.virtual import Gear, VirtualBus, VirtualServo
from pantograph.sim.errors import RecordingError
from pantograph.sim.recording import load
from pantograph.sim.run import run
from pantograph.sim.scene.schema import Scene
from test_mirror import MODEL
from test_servo_faults import RIG
from typer.testing import CliRunner

IDS = (1, 2, 3)
COMMAND = [sys.executable, "-c", "from pantograph.hardware.cli import app; app()"]


def invoke(*args: object):
    return CliRunner().invoke(app, [str(a) for a in args], env={"COLUMNS": "200"})


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    (tmp_path / "arm.xml").write_text(MODEL)
    path = tmp_path / "rig.toml"
    text = RIG.replace('name = "test rig"', 'name = "test rig"\nmodel = "arm.xml"')
    path.write_text(text.replace("watchdog = 0.1", "watchdog = 0.5"))  # a busy machine may stall that long
    return path


@pytest.fixture
def recording(rig: Path) -> Path:
    """Eight seconds of a wave."""
    t = np.linspace(0, 8, 33)
    keys = [
        {"joint": "elbow", "times": list(t), "values": list(0.5 * np.sin(2 * t)), "curve": "natural"},
        {"joint": "wrist", "times": list(t), "values": list(0.4 * np.cos(2 * t)), "curve": "natural"},
    ]
    scene = Scene(duration=8, models=[{"file": str(rig.parent / "arm.xml")}], keys=keys)
    return run(scene).save(rig.parent / "wave.npz")


@contextmanager
def simulated(*what: object, link: Path) -> Iterator[str]:
    """Virtual servos in a process of their own, on a pseudo-terminal."""
    process = subprocess.Popen(
        [*COMMAND, "simulate", *map(str, what), "--link", str(link)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith(f"port {link}: ")
        yield str(link)
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0
        assert not link.exists()


def reader(port: str) -> Driver:
    opened, clock = open_port(port, 1_000_000)
    driver = Driver(opened, clock, margin=0.1)
    for id in IDS:
        driver.ping(id)
    return driver


def wait_for(process: subprocess.Popen[str], word: str) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == word:
            return
    raise AssertionError(f"the process ended before {word!r}")


MIRROR = """
import sys
from pantograph.hardware.mirror import mirror_recording
mirror_recording(sys.argv[1], sys.argv[2], port=sys.argv[3], on_phase=lambda p: print(p, flush=True))
"""


def test_killed_mirror_leaves_servos_stopped_by_their_watchdogs(rig: Path, recording: Path) -> None:
    with simulated(rig, link=rig.parent / "bus") as port:
        mirror = subprocess.Popen(
            [sys.executable, "-c", MIRROR, str(recording), str(rig), port], stdout=subprocess.PIPE, text=True
        )
        wait_for(mirror, "stream")
        time.sleep(0.7)
        os.kill(mirror.pid, signal.SIGKILL)
        assert mirror.wait(5) == -signal.SIGKILL
        time.sleep(1.2)  # the rig's watchdog is 0.5 s
        driver = reader(port)
        try:
            assert [driver.read_raw(i, "bus_watchdog") for i in IDS] == [-1, -1, -1]
            before = [driver.read(i, "present_position") for i in IDS]
            assert abs(before[0]) > 0.02  # it had begun to move
            for i in IDS:  # and goals are refused until a person clears the watchdog
                with pytest.raises(HardwareError):
                    driver.write(i, "goal_position", 0.0)
            time.sleep(0.4)
            after = [driver.read(i, "present_position") for i in IDS]
            assert np.allclose(before, after, atol=2e-3)
        finally:
            driver.close()


def test_a_device_that_goes_away_is_told_and_ends_the_play(rig: Path, recording: Path) -> None:
    """As when the cable is torn out: the terminal of killed servos gives errors of several kinds."""
    link = rig.parent / "bus"
    servos = subprocess.Popen(
        [*COMMAND, "simulate", str(rig), "--link", str(link)], stdout=subprocess.PIPE, text=True
    )
    assert servos.stdout is not None
    assert servos.stdout.readline().startswith("port ")
    play = subprocess.Popen(
        [*COMMAND, "play", str(recording), str(rig), "--port", str(link)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    wait_for(play, "stream")
    time.sleep(0.5)
    servos.kill()
    servos.wait(5)
    said = play.communicate(timeout=20)[0]
    assert play.returncode == 1
    assert "Traceback" not in said
    assert "is gone" in " ".join(said.split())  # wherever lines break


def test_terminated_play_stops_as_promised(rig: Path, recording: Path) -> None:
    with simulated(rig, link=rig.parent / "bus") as port:
        play = subprocess.Popen(
            [*COMMAND, "play", str(recording), str(rig), "--port", port, "--stop", "limp"],
            stdout=subprocess.PIPE,
            text=True,
        )
        wait_for(play, "stream")
        time.sleep(0.7)
        play.send_signal(signal.SIGTERM)
        out, _ = play.communicate(timeout=10)
        assert play.returncode == 130 and "interrupted in phase" in out and "limp: torque is off" in out
        driver = reader(port)
        try:
            assert [driver.read_raw(i, "torque_enable") for i in IDS] == [0, 0, 0]
        finally:
            driver.close()


def test_a_session_at_the_terminal(rig: Path) -> None:
    """scan, monitor, jog, set-id, set-baud, stop against one virtual rig."""
    with simulated(rig, link=rig.parent / "bus") as port:
        result = invoke("scan", port, "--baud", 1_000_000)
        assert result.exit_code == 0 and result.output.count("xm430-w350") == 2
        result = invoke("monitor", rig, "--port", port, "--seconds", 0)
        assert result.exit_code == 0 and "tip" in result.output and "no answer" not in result.output
        result = invoke("jog", rig, "elbow", "--port", port, "--", 5)
        assert result.exit_code == 0, result.output
        at = float(result.output.split("elbow is at ")[1].split()[0])
        assert 4.0 < at < 5.2
        result = invoke("jog", rig, "elbow", "--port", port, "--", 200)
        assert isinstance(result.exception, HardwareError) and "outside" in str(result.exception)
        assert invoke("stop", rig, "--port", port, "--limp").exit_code == 0
        assert "servo 9 now" in invoke("set-id", port, 3, 9).output
        result = invoke("monitor", rig, "--port", port, "--seconds", 0)
        assert isinstance(result.exception, HardwareError) and "(joint wrist)" in str(result.exception)
        assert invoke("set-id", port, 9, 3).exit_code == 0
        assert "57,600" in invoke("set-baud", port, 3, 57_600, "--baud", 1_000_000).output
        assert invoke("set-baud", port, 3, 1_000_000).exit_code == 0


def test_play_in_memory_saves_the_rigs_recording(rig: Path, recording: Path) -> None:
    out = rig.parent / "rig.npz"
    result = invoke("play", recording, rig, "--stop", "park", "--out", out)
    assert result.exit_code == 0, result.output
    assert "parked, then limp" in result.output and "delay" in result.output
    assert load(out).q.shape[1] == 2


def test_a_recording_that_could_not_be_saved_is_told_before_anything_moves(
    rig: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = lambda *args, **_: pytest.fail("moved")  # noqa: E731
    monkeypatch.setattr("pantograph.hardware.cli.motion.play_recording", moved)
    monkeypatch.setattr("pantograph.hardware.mirror.teleop.teleoperate", moved)
    (rig.parent / "file").touch()
    for command in (("play", recording, rig), ("teleop", rig)):
        outcome = invoke(*command, "--out", rig.parent / "file" / "rig.npz")
        assert isinstance(outcome.exception, RecordingError)
        assert "cannot write into" in str(outcome.exception)


def test_play_refuses_and_says_how_to_go_on(rig: Path, recording: Path) -> None:
    rig.write_text(rig.read_text().replace("velocity = 3.0", "velocity = 0.6"))
    result = invoke("play", recording, rig)
    assert isinstance(result.exception, MotionRefused) and "--slow" in str(result.exception)
    result = invoke("play", recording, rig, "--slow")
    assert result.exit_code == 0 and "times slower" in result.output
    assert isinstance(invoke("play", recording, rig, "--stop", "drop").exception, HardwareError)
    assert isinstance(invoke("play", recording, "no_such_rig").exception, HardwareError)
    assert isinstance(invoke("play", recording, rig, "--port", "/dev/no").exception, HardwareError)


def test_live_through_the_function_that_run_uses(rig: Path, recording: Path) -> None:
    scene = Scene(
        duration=1,
        models=[{"file": str(rig.parent / "arm.xml")}],
        keys=[{"joint": "elbow", "times": [0, 1], "values": [0, 0.4]}],
        roles={"passive": ["wrist"]},
    )
    assert play_recording(scene, rig, live=True, stop="limp").status == "done"


def test_teleop_without_follower_saves_the_leader(rig: Path) -> None:
    out = rig.parent / "leader.npz"
    result = invoke("teleop", rig, "--seconds", 0.5, "--out", out)
    assert result.exit_code == 0 and "poses of elbow, wrist" in result.output
    assert load(out).q.shape == (26, 2)


def test_single_servos_are_simulated_by_model(tmp_path: Path) -> None:
    with simulated("xl330-m288", "mx-28", link=tmp_path / "bus") as port:
        output = invoke("scan", port, "--baud", 1_000_000).output
        assert "xl330-m288" in output and "mx-28" in output


# Calibration.


class Hands:
    """A person who does what is asked: moves the shafts of virtual servos."""

    def __init__(self, bus: VirtualBus, truth, poses: dict[str, list[np.ndarray]]) -> None:
        self.bus, self.truth, self.poses = bus, truth, poses
        self.asked: list[str] = []
        self._left: list[np.ndarray] = []

    def ready(self, request: str) -> bool:
        if not self.asked or self.asked[-1] != request:
            self.asked.append(request)
            key = next(k for k in self.poses if k in request)
            self._left = list(self.poses[key])
        if not self._left:
            return True
        for s, angle in zip(self.bus.servos, self.truth.servo(self._left.pop(0)), strict=True):
            s.drive.plant.position = s.drive.plant.gear = float(angle)
        self.bus.advance(0.01)
        return not self._left

    def show(self, names, position, low, high) -> None:
        assert len(names) == len(position) == 3


def calibration():
    """Two joints; elbow on servos 1 and 3 (reversed), wrist on servo 2, zeros anywhere."""
    truth = make_mapping(
        parse_rig(
            """angle = "degree"
            servos = [
                { name = "a", id = 1, model = "xm430-w350" },
                { name = "b", id = 2, model = "xm430-w350" },
                { name = "c", id = 3, model = "xm430-w350" },
            ]
            [[joints]]
            joint = "elbow"
            servos = [{ servo = "a", zero = 20 }, { servo = "c", direction = -1, zero = -33 }]
            [[joints]]
            joint = "wrist"
            servo = "b"
            direction = -1
            zero = 61"""
        )
    )
    servos = [VirtualServo("xm430-w350", i, baud=1_000_000, plant=Gear(0.01)) for i in IDS]
    bus = VirtualBus(servos)
    port, clock = open_port("virtual", 1_000_000, bus=bus)
    driver = Driver(port, clock)
    found = list(driver.broadcast_ping().values())
    z = np.zeros(2)
    poses = {
        "zero": [np.array([0.3, 0.1]), z],
        "'elbow'": [np.array([0.2, 0.0]), np.array([0.4, 0.02])],
        "'wrist'": [np.array([0.4, 0.3])],
        "range": [np.array([-1.0, -0.5]), np.array([0.9, 0.7]), z],
    }
    return driver, bus, truth, found, poses


def test_calibration_finds_servos_directions_zeros_and_ranges() -> None:
    driver, bus, truth, found, poses = calibration()
    result = calibrate(driver, found, ["elbow", "wrist"], Hands(bus, truth, poses))
    model = mujoco.MjModel.from_xml_string(MODEL)
    text = rig_text("mine", "arm.xml", model, found, result, port="/dev/ttyUSB0", baud=1_000_000)
    rig = parse_rig(text)
    check_model(rig, model)
    mapping = make_mapping(rig)
    for q in (np.zeros(2), np.array([0.5, -0.3]), np.array([-0.9, 0.6])):
        mine = dict(zip(mapping.ids, mapping.servo(q), strict=True))
        assert np.allclose([mine[i] for i in IDS], truth.servo(q), atol=4e-3)
    elbow, wrist = (np.radians(j.range) for j in rig.joints)
    assert np.allclose(elbow, [-0.98, 0.88], atol=5e-3) and np.allclose(wrist, [-0.48, 0.68], atol=5e-3)


def test_calibration_refuses_torque_and_joints_that_did_not_move() -> None:
    driver, bus, truth, found, poses = calibration()
    bus.servos[1].memory.put("torque_enable", 1)
    with pytest.raises(HardwareError, match="servo 2 holds torque"):
        calibrate(driver, found, ["elbow", "wrist"], Hands(bus, truth, poses))
    bus.servos[1].memory.put("torque_enable", 0)
    still = poses | {"'wrist'": [np.array([0.4, 0.03])]}
    with pytest.raises(HardwareError, match="no servo turned when joint 'wrist'"):
        calibrate(driver, found, ["elbow", "wrist"], Hands(bus, truth, still))
