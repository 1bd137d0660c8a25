"""Virtual servos: profiles, motor and registers against closed forms and the rules of the manual."""

from itertools import pairwise
from math import exp, inf, pi, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.hardware import packets as p
from pantograph.hardware.errors import HardwareError, RegisterError
from pantograph.hardware.packets import ALERT, StatusError
from pantograph.hardware.registers import model_names
from pantograph.hardware.tables.rows import ACCELERATION, VELOCITY
from pantograph.hardware.virtual import MOTORS, Gear, Motor, Quirks, VirtualServo, joints
from pantograph.hardware.virtual.profile import (
    RECTANGULAR,
    TRAPEZOIDAL,
    TRIANGULAR,
    ramp_to,
    timed,
    trapezoid,
)
from scipy.linalg import expm

OK = StatusError.NONE
positive = st.floats(0.05, 20)
place = st.floats(-10, 10)


def write(servo: VirtualServo, name: str, raw: int) -> int:
    """Write a register over the protocol; the error byte of the reply."""
    r = servo.table[name]
    reply = servo.execute(p.write(servo.id, r.address, r.encode(raw)))
    assert reply is not None
    return reply.params[0]


def read(servo: VirtualServo, name: str) -> int:
    """Read a register over the protocol."""
    r = servo.table[name]
    reply = servo.execute(p.read(servo.id, r.address, r.size))
    assert reply is not None and reply.error == OK
    return r.decode(reply.data)


def run(servo: VirtualServo, seconds: float) -> None:
    for _ in range(round(seconds / 1e-3)):
        servo.step()


def ready(model: str = "xm430-w350", mode: int = 3, **registers: int) -> VirtualServo:
    """Servo with torque on in a mode."""
    servo = VirtualServo(model, registers={"operating_mode": mode, **registers})
    assert write(servo, "torque_enable", 1) == OK
    return servo


# Profiles.


@given(place, st.floats(-3, 3), place, positive, positive)
def test_trapezoid_keeps_its_promises(x, v, goal, speed, acceleration):
    """Continuous, within speed and acceleration, at rest on the goal; its velocity integrates to the way."""
    t = trapezoid(x, v, goal, speed=speed, acceleration=acceleration)
    at, vt = x, v
    for s in t.segments:
        assert s.x == pytest.approx(at, abs=1e-9) and s.v == pytest.approx(vt, abs=1e-9)
        assert abs(s.a) <= acceleration * (1 + 1e-9)
        at, vt = s.x + s.duration * (s.v + s.a * s.duration / 2), s.v + s.a * s.duration
        assert abs(vt) <= max(speed, abs(v)) * (1 + 1e-9)
    assert at == pytest.approx(goal, abs=1e-6) and vt == pytest.approx(0, abs=1e-6)
    assert t.at(t.duration + 1) == (goal, 0)


@given(place, place, positive, positive)
def test_trapezoid_from_rest_is_the_textbooks(x, goal, speed, acceleration):
    """Duration, peak speed and type from rest: way / V + V / A, or 2 sqrt(way / A) when V is not reached."""
    way = abs(goal - x)
    t = trapezoid(x, 0.0, goal, speed=speed, acceleration=acceleration)
    reaches = way > speed**2 / acceleration
    duration = way / speed + speed / acceleration if reaches else 2 * sqrt(way / acceleration)
    assert t.duration == pytest.approx(duration, rel=1e-9, abs=1e-9)
    if abs(way - speed**2 / acceleration) > 1e-9 * way:
        assert t.kind == (TRAPEZOIDAL if reaches else TRIANGULAR)
    _, peak = t.at(duration / 2)
    assert abs(peak) == pytest.approx(min(speed, sqrt(way * acceleration)), rel=1e-6, abs=1e-9)
    ramp = abs(peak) / acceleration  # between these corners the velocity is linear, so that the rule is exact
    corners = [0.0, ramp, duration - ramp, duration]
    area = np.trapezoid([t.at(s)[1] for s in corners], corners)
    assert area == pytest.approx(goal - x, rel=1e-6, abs=1e-6)


@given(place, st.floats(-3, 3), place, st.floats(0.1, 5), st.floats(0.01, 5))
def test_timed_profile_arrives_on_time(x, v, goal, duration, ramp):
    t = timed(x, v, goal, duration=duration, ramp=ramp)
    ramp = min(ramp, duration / 2)
    assert t.duration == pytest.approx(duration)
    assert t.at(duration)[0] == pytest.approx(goal, abs=1e-9)
    for a, b in pairwise(t.segments):
        assert a.x + a.duration * (a.v + a.a * a.duration / 2) == pytest.approx(b.x, abs=1e-9)
    if v == 0:
        assert t.at(ramp)[1] == pytest.approx((goal - x) / (duration - ramp), abs=1e-9)


def test_degenerate_profiles():
    assert trapezoid(1, 0, 5).at(0) == (5, 0)
    flat = trapezoid(0, 0, -2, speed=4)
    assert (flat.duration, flat.at(0.25), flat.kind) == (0.5, (-1.0, -4), RECTANGULAR)
    assert trapezoid(3, 0, 3, speed=1, acceleration=1).duration == 0
    assert ramp_to(0, 1, 4, acceleration=2).at(1.5) == pytest.approx((3.75, 4))
    assert ramp_to(0, 0, 4, duration=2).at(1) == pytest.approx((1, 2))
    assert ramp_to(0, 0, 4).at(0) == (0, 4)
    assert timed(0, 0, 1, duration=0, ramp=0).at(0) == (1, 0)
    assert timed(0, 0, 1, duration=2, ramp=0).at(1) == (0.5, 0.5)


@settings(max_examples=25, deadline=None)
@given(st.integers(20, 180), st.integers(1, 60), st.integers(0, 4095))
def test_profile_of_the_registers(velocity, acceleration, goal):
    """t1 = 64 V / A ms and t3 = t1 + 64 way / V ms of the manual, read from the trajectory registers."""
    servo = ready()
    write(servo, "profile_velocity", velocity)
    write(servo, "profile_acceleration", acceleration)
    write(servo, "goal_position", goal)
    way, v, a = abs(goal - 2048) * 2 * pi / 4096, velocity * VELOCITY, acceleration * ACCELERATION
    duration = way / v + v / a if way > v * v / a else 2 * sqrt(way / a)
    peak, steps = 0, 0
    while read(servo, "moving_status") & 2:
        peak = max(peak, abs(read(servo, "velocity_trajectory")))
        servo.step()
        steps += 1
        assert steps < 60_000
    assert steps * 1e-3 == pytest.approx(duration, abs=2e-3)
    assert peak == pytest.approx(min(velocity, sqrt(way * a) / VELOCITY), rel=0.02, abs=1)
    assert read(servo, "position_trajectory") == goal


def test_velocity_limit_bounds_the_profile():
    servo = ready(mode=4)
    write(servo, "profile_velocity", 1000)
    write(servo, "goal_position", 20_000)
    assert read(servo, "velocity_trajectory") == read(servo, "velocity_limit") == 200


def test_a_new_goal_keeps_the_velocity():
    servo = ready(mode=4)
    write(servo, "profile_velocity", 150)
    write(servo, "profile_acceleration", 20)
    write(servo, "goal_position", 8000)
    run(servo, 1.0)
    before = read(servo, "velocity_trajectory")
    write(servo, "goal_position", -8000)
    assert before > 100
    servo.step()
    assert read(servo, "velocity_trajectory") == pytest.approx(before, abs=2)


def test_time_based_profile_of_the_registers():
    servo = VirtualServo("xm430-w350", registers={"drive_mode": 4})
    write(servo, "torque_enable", 1)
    write(servo, "profile_velocity", 1500)
    write(servo, "profile_acceleration", 500)
    write(servo, "goal_position", 3048)
    run(servo, 1.499)
    assert read(servo, "moving_status") & 2
    run(servo, 0.002)
    assert not read(servo, "moving_status") & 2 and read(servo, "position_trajectory") == 3048


# Motor.


def test_blocked_current_is_a_first_order_step():
    motor = MOTORS["xm430-w350"]
    i = 0.0
    for n in range(1, 20):
        i = motor.current(i, motor.voltage, 0.0, 3e-4)
        assert i == pytest.approx(
            motor.stall_current * (1 - exp(-n * 3e-4 / motor.electrical_time)), rel=1e-12
        )


@pytest.mark.parametrize("model", model_names())
def test_stall_torque_and_no_load_speed_are_the_manuals(model):
    """Full PWM, unloaded: the manual's speed; blocked: its current, and its torque after friction."""
    motor = MOTORS[model]
    servo = VirtualServo(model, registers={"operating_mode": 16}, motor=motor)
    write(servo, "torque_enable", 1)
    write(servo, "goal_pwm", 885)
    run(servo, 1.0)
    drop = servo.drive.voltage / motor.voltage  # the cable takes its part
    assert servo.drive.velocity == pytest.approx(motor.no_load_speed * drop, rel=0.01)
    assert motor.kt * motor.stall_current - motor.coulomb == pytest.approx(motor.stall_torque)


def response(dt: float) -> float:
    """Speed after 30 ms of constant voltage with motor and gear in steps of dt."""
    motor = Motor(12.0, 4.1, 2.3, 4.8, friction=0.0, electrical_time=4e-3)
    gear, i, speed = Gear(motor.inertia), 0.0, 0.0
    for _ in range(round(0.03 / dt)):
        i = motor.current(i, 12.0, speed, dt)
        _, speed = gear.step(dt, motor.kt * i)
    return speed


def test_motor_and_gear_follow_the_linear_system():
    """d/dt (i, w) = A (i, w) + b has a closed form; the error of the steps is of first order."""
    motor = Motor(12.0, 4.1, 2.3, 4.8, friction=0.0, electrical_time=4e-3)
    inductance = motor.electrical_time * motor.resistance
    a = np.array([[-motor.resistance / inductance, -motor.ke / inductance], [motor.kt / motor.inertia, 0.0]])
    b = np.array([12.0 / inductance, 0.0])
    exact = np.linalg.solve(a, (expm(a * 0.03) - np.eye(2)) @ b)[1]
    errors = [abs(response(dt) - exact) for dt in (1e-3, 5e-4, 2.5e-4)]
    assert errors[0] < 0.02 * exact
    slopes = [np.log2(x / y) for x, y in pairwise(errors)]
    assert slopes == pytest.approx([1, 1], abs=0.1)


def test_friction_holds_and_slows():
    gear = Gear(0.01, 0.2)
    for _ in range(100):
        assert gear.step(1e-3, 0.199) == (0, 0)
    gear = Gear(0.01, 0.2, velocity=1.0)
    for _ in range(40):
        gear.step(1e-3, 0.0)
    assert gear.velocity == pytest.approx(1.0 - 0.2 / 0.01 * 0.04)
    gear.step(0.5, 0.0)
    assert gear.velocity == 0


def test_backlash_loses_the_play_at_a_reversal():
    gear = Gear(0.01, 0.0, backlash=0.02)
    while gear.gear < 0.5:
        gear.step(1e-3, 1.0)
    assert gear.position == pytest.approx(gear.gear - 0.01)
    gear.velocity, stood = -1.0, gear.position
    gear.step(0.019, 0.0)
    assert gear.position == stood
    gear.step(0.011, 0.0)
    assert gear.position == pytest.approx(stood - 0.01)


def test_joints_of_one_simulation_advance_together():
    """Two servos on two coupled masses: the group steps once a period, with both torques."""
    seen = []

    def step(dt, torques):
        seen.append((dt, tuple(torques)))
        return [len(seen), -len(seen)], [1.0, -1.0]

    a, b = joints(step, [0.0, 0.0], [0.0, 0.0])
    assert a.step(1e-3, 2.0) == (0, 0) and seen == []
    assert b.step(1e-3, 3.0) == (-1, -1) and seen == [(1e-3, (2.0, 3.0))]
    assert a.step(1e-3, 4.0) == (1, 1)


def test_servos_feel_the_gravity_of_a_simulation():
    """A pendulum in MuJoCo, held level: the current carries m g l but for what friction takes."""
    import mujoco

    motor = MOTORS["xm430-w350"]
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><option timestep="1e-3" integrator="implicitfast"/><worldbody><body>
          <joint axis="0 1 0" armature="{motor.inertia}" frictionloss="{motor.coulomb}"/>
          <geom type="sphere" size="0.02" mass="0.5" pos="0.2 0 0"/>
        </body></worldbody></mujoco>""")
    data = mujoco.MjData(model)

    def step(dt, torques):
        assert dt in (0.0, model.opt.timestep)
        if dt:
            data.qfrc_applied[:] = torques
            mujoco.mj_step(model, data)
        return data.qpos.copy(), data.qvel.copy()

    (joint,) = joints(step, data.qpos.copy(), data.qvel.copy())
    servo = VirtualServo("xm430-w350", plant=joint)
    write(servo, "torque_enable", 1)
    run(servo, 2.0)
    torque, weight = motor.kt * servo.drive.current, 0.5 * 9.81 * 0.2 * np.cos(data.qpos[0])
    assert abs(read(servo, "present_position") - 2048) < 60 and data.qpos[0] > 0.01
    assert -torque == pytest.approx(weight, abs=1.05 * motor.coulomb)
    assert servo.si("present_current") * motor.kt == pytest.approx(torque, abs=0.01)


# Modes.


@pytest.mark.parametrize("model", model_names())
def test_every_model_goes_where_it_is_told(model):
    servo = ready(model)
    for goal in (3000, 900):
        assert write(servo, "goal_position", goal) == OK
        run(servo, 2.5)
        assert abs(read(servo, "present_position") - goal) <= 20
        assert read(servo, "moving") == 0 and read(servo, "moving_status") & 1


@pytest.mark.parametrize("reverse", [0, 1])
def test_velocity_mode(reverse):
    servo = ready(mode=1, drive_mode=reverse)
    assert write(servo, "goal_velocity", 100) == OK
    run(servo, 2.0)
    assert read(servo, "present_velocity") == pytest.approx(100, abs=2)
    assert (servo.drive.shaft_velocity > 0) == (reverse == 0)
    assert read(servo, "moving") == 1
    assert write(servo, "goal_velocity", 201) == StatusError.DATA_LIMIT


def test_velocity_mode_ramps_with_the_profile():
    servo = ready(mode=1)
    write(servo, "profile_acceleration", 10)
    write(servo, "goal_velocity", 150)
    run(servo, 64e-3 * 150 / 10 / 2)
    assert read(servo, "velocity_trajectory") == pytest.approx(75, abs=1)


def test_current_mode_holds_a_torque():
    """A spring on the horn: at rest the spring takes the torque, friction left aside."""
    motor = MOTORS["xm430-w350"]
    gear = Gear(motor.inertia, 0.0, load=lambda q, v: -2.0 * q - 0.3 * v)
    servo = VirtualServo("xm430-w350", plant=gear, registers={"operating_mode": 0})
    write(servo, "torque_enable", 1)
    write(servo, "goal_current", 300)
    run(servo, 3.0)
    assert read(servo, "present_current") == pytest.approx(300, abs=3)
    assert servo.drive.shaft == pytest.approx(motor.kt * 300 * 2.69e-3 / 2.0, rel=0.02)
    assert write(servo, "goal_current", 1194) == StatusError.DATA_LIMIT


def test_current_based_position_yields_to_a_stop():
    motor = MOTORS["xm430-w350"]
    servo = VirtualServo(
        "xm430-w350",
        plant=Gear(motor.inertia, motor.coulomb, stop=(-0.5, 0.5)),
        registers={"operating_mode": 5},
    )
    write(servo, "torque_enable", 1)
    write(servo, "goal_current", 200)
    write(servo, "goal_position", 4000)
    run(servo, 3.0)
    assert read(servo, "present_current") == pytest.approx(200, abs=3)
    assert read(servo, "hardware_error_status") == 0
    assert servo.si("present_position") == pytest.approx(0.5, abs=2e-3)


def test_extended_position_counts_turns_and_a_reboot_forgets_them():
    servo = ready(mode=4)
    write(servo, "goal_position", 2048 + 3 * 4096 + 100)
    run(servo, 8.0)
    assert read(servo, "present_position") == pytest.approx(2048 + 3 * 4096 + 100, abs=20)
    before = read(servo, "present_position")
    servo.execute(p.reboot(1))
    assert not servo.awake
    run(servo, 0.2)
    assert servo.awake and read(servo, "torque_enable") == 0
    assert read(servo, "present_position") == before - 3 * 4096
    assert read(servo, "goal_position") == read(servo, "present_position")


def test_clear_brings_back_into_one_turn_but_not_in_motion():
    servo = ready(mode=4)
    write(servo, "goal_position", 10_000)
    run(servo, 0.5)
    assert servo.execute(p.clear_turns(1)).error == StatusError.RESULT_FAIL
    run(servo, 6.0)
    before = read(servo, "present_position")
    assert servo.execute(p.clear_turns(1)).error == OK
    assert read(servo, "present_position") == before - 2 * 4096
    run(servo, 1.0)
    assert read(servo, "present_position") == pytest.approx(before - 2 * 4096, abs=20)


@pytest.mark.parametrize(("mode", "register", "limit"), [(0, "goal_current", 1193), (16, "goal_pwm", 885)])
def test_effort_goals_stand_at_their_limits_or_not(mode, register, limit):
    for is_open in (True, False):
        servo = VirtualServo("xm430-w350", quirks=Quirks(effort_goals_open=is_open))
        write(servo, "operating_mode", mode)
        write(servo, "torque_enable", 1)
        assert read(servo, register) == (limit if is_open else 0)
        run(servo, 0.2)
        assert (abs(read(servo, "present_velocity")) > 50) == is_open


def test_pwm_limits_every_mode():
    servo = ready(mode=4)
    write(servo, "goal_pwm", 200)
    write(servo, "goal_position", 100_000)
    run(servo, 1.0)
    assert read(servo, "present_pwm") == 200
    assert write(servo, "goal_pwm", 886) == StatusError.DATA_LIMIT


# Position frame.


@pytest.mark.parametrize(("offset", "seen"), [(500, 500), (-1024, -1024), (1025, 0), (-5000, 0)])
def test_homing_offset_counts_only_within_a_quarter_turn_in_position_mode(offset, seen):
    servo = VirtualServo("xm430-w350", position=0.3)
    bare = read(servo, "present_position")
    assert write(servo, "homing_offset", offset) == OK
    assert read(servo, "present_position") == bare + seen
    write(servo, "operating_mode", 4)
    assert read(servo, "present_position") == bare + (seen or 0)
    write(servo, "homing_offset", offset)
    assert read(servo, "present_position") == bare + offset


@given(st.floats(-pi + 0.01, pi - 0.01), st.integers(-1024, 1024))
def test_reverse_mode_mirrors_the_position(angle, offset):
    servo = VirtualServo("xm430-w350", position=angle, registers={"homing_offset": offset})
    straight = read(servo, "present_position") - offset
    write(servo, "drive_mode", 1)
    assert read(servo, "present_position") - offset == pytest.approx(4096 - straight, abs=1)


def test_position_limits_bind_in_position_mode_alone():
    servo = ready(min_position_limit=1000, max_position_limit=3000)
    assert write(servo, "goal_position", 3001) == StatusError.DATA_LIMIT
    assert write(servo, "goal_position", 999) == StatusError.DATA_LIMIT
    assert write(servo, "goal_position", 3000) == OK
    servo = ready(mode=4, min_position_limit=1000, max_position_limit=3000)
    assert write(servo, "goal_position", 1_048_575) == OK
    assert write(servo, "goal_position", 1_048_576) == StatusError.DATA_RANGE
    strict = VirtualServo("xm430-w350", quirks=Quirks(goal_limit_error=StatusError.DATA_RANGE))
    assert write(strict, "goal_position", 4096) == StatusError.DATA_RANGE


def test_torque_on_in_position_mode_forgets_turns():
    servo = VirtualServo("xm430-w350", registers={"operating_mode": 3})
    servo.drive.plant.gear = servo.drive.plant.position = 2 * pi + 0.5
    run(servo, 0.01)
    assert read(servo, "present_position") > 6000
    write(servo, "torque_enable", 1)
    assert read(servo, "present_position") < 4096


@pytest.mark.parametrize("survives", [True, False])
def test_a_stale_goal_is_dangerous_or_not(survives):
    servo = VirtualServo("xm430-w350", quirks=Quirks(goal_survives_torque_off=survives))
    write(servo, "goal_position", 3000)
    run(servo, 0.5)
    assert read(servo, "present_position") == 2048
    write(servo, "torque_enable", 1)
    run(servo, 2.0)
    assert read(servo, "present_position") == pytest.approx(3000 if survives else 2048, abs=20)


def test_torque_on_by_goal():
    servo = VirtualServo("xm430-w350", registers={"drive_mode": 8})
    write(servo, "goal_velocity", 10)  # not the goal of this mode
    assert read(servo, "torque_enable") == 0
    write(servo, "goal_position", 2500)
    assert read(servo, "torque_enable") == 1
    run(servo, 1.5)
    assert read(servo, "present_position") == pytest.approx(2500, abs=20)


# Access.


def test_eeprom_is_locked_while_torque_is_on():
    servo = ready()
    locked = [r for r in servo.table.registers if r.area == "EEPROM" and r.access == "RW"]
    assert len(locked) > 15
    for r in locked:
        raw = servo.get(r.name)
        assert write(servo, r.name, raw) == StatusError.ACCESS
    write(servo, "torque_enable", 0)
    for r in locked:
        assert write(servo, r.name, servo.get(r.name)) == OK, r.name


def test_answers_to_wrong_writes():
    servo = VirtualServo("xm430-w350")
    address = servo.table["goal_position"].address
    expect = {
        p.write(1, 132, bytes(4)): StatusError.ACCESS,  # read only
        p.write(1, 130, bytes(1)): StatusError.ACCESS,
        p.write(1, 15, bytes(1)): StatusError.ACCESS,  # no register
        p.write(1, 5000, bytes(1)): StatusError.ACCESS,
        p.write(1, address, bytes(2)): StatusError.DATA_LENGTH,
        p.write(1, address, b""): StatusError.DATA_LENGTH,
        p.write(1, 9, b"\xff"): StatusError.DATA_RANGE,
        p.write(1, 11, b"\x07"): StatusError.DATA_RANGE,  # no such mode
        p.write(1, 98, b"\x80"): StatusError.DATA_RANGE,
        p.read(1, 600, 100): StatusError.ACCESS,
        p.Packet(1, 0x77): StatusError.INSTRUCTION,
        p.action(1): StatusError.INSTRUCTION,
        p.Packet(1, p.Instruction.READ, b"\0"): StatusError.INSTRUCTION,
    }
    before = servo.memory.eeprom()
    for packet, error in expect.items():
        reply = servo.execute(packet)
        assert (reply.error, reply.data) == (error, b""), packet
    assert servo.memory.eeprom() == before


def test_a_write_is_all_or_nothing():
    """LED and torque in one write, of which the second is out of range."""
    servo = VirtualServo("xm430-w350")
    assert servo.execute(p.write(1, 64, b"\x02\x01")).error == StatusError.DATA_RANGE
    assert read(servo, "led") == 0
    assert servo.execute(p.write(1, 64, b"\x01\x01")).error == OK
    assert (read(servo, "torque_enable"), read(servo, "led")) == (1, 1)


@pytest.mark.parametrize(
    ("level", "answers"), [(0, (True, False, False)), (1, (True, True, False)), (2, (True, True, True))]
)
def test_status_return_level(level, answers):
    servo = VirtualServo("xm430-w350", registers={"status_return_level": 2})
    servo.memory.put("status_return_level", level)
    replies = (servo.execute(p.ping(1)), servo.execute(p.read(1, 7, 1)), servo.execute(p.write(1, 65, b"\1")))
    assert tuple(r is not None for r in replies) == answers
    assert servo.get("led") == 1


def test_indirect_registers_map_byte_by_byte():
    servo = ready(mode=3)
    wanted = ["present_position", "present_current", "hardware_error_status"]
    bytes_of = [
        a for n in wanted for a in range(servo.table[n].address, servo.table[n].address + servo.table[n].size)
    ]
    for i, address in enumerate(bytes_of, 1):
        assert write(servo, f"indirect_address_{i}", address) == OK
    write(servo, "goal_position", 2900)
    run(servo, 0.2)
    block = servo.execute(p.read(1, servo.table["indirect_data_1"].address, len(bytes_of))).data
    direct = b"".join(servo.table[n].encode(read(servo, n)) for n in wanted)
    assert block == direct
    assert write(servo, "indirect_address_1", 63) == StatusError.DATA_RANGE
    assert (
        servo.execute(p.write(1, 224, bytes(1))).error == StatusError.ACCESS
    )  # present position is read only


def test_indirect_writes_obey_the_register_they_reach():
    servo = ready()
    for i in range(4):
        write(servo, f"indirect_address_{29 + i}", 116 + i)
    assert servo.execute(p.write(1, 634, (3000).to_bytes(4, "little"))).error == OK
    assert read(servo, "goal_position") == 3000
    assert servo.execute(p.write(1, 634, (5000).to_bytes(4, "little"))).error == StatusError.DATA_LIMIT
    assert servo.execute(p.write(1, 634, b"\0\0")).error == StatusError.DATA_LENGTH
    run(servo, 2.0)
    assert read(servo, "present_position") == pytest.approx(3000, abs=20)


@given(
    st.integers(0, 700), st.binary(max_size=40), st.booleans(), st.sampled_from(["xl330-m288", "xl430-w250"])
)
@settings(max_examples=150, deadline=None)
def test_no_write_breaks_a_servo(address, data, torque, model):
    servo = VirtualServo(model, registers={"torque_enable": 0})
    if torque:
        write(servo, "torque_enable", 1)
    id_before = servo.id
    reply = servo.execute(p.write(id_before, address, data))
    assert reply is None or reply.error in set(StatusError)
    for _ in range(15):
        servo.step()
    assert servo.execute(p.ping(servo.id)) is not None


# Watchdog and protection.


@pytest.mark.parametrize("mode", [0, 1, 3, 4, 5, 16])
def test_watchdog_stops_in_time(mode):
    servo = ready(mode=mode)
    goal = {0: "goal_current", 1: "goal_velocity", 16: "goal_pwm"}.get(mode, "goal_position")
    write(servo, "bus_watchdog", 5)
    write(servo, "profile_velocity", 40)
    write(servo, goal, {"goal_position": 4000}.get(goal, 150))
    servo.feed()
    run(servo, 0.099)
    assert read(servo, "bus_watchdog") == 5 and read(servo, "moving") == 1
    run(servo, 0.003)
    assert read(servo, "bus_watchdog") == -1
    run(servo, 0.5)
    assert read(servo, "moving") == 0 and read(servo, "present_velocity") == 0
    stopped = read(servo, "present_position")
    assert read(servo, "torque_enable") == 1 and read(servo, "profile_velocity") == 0
    assert write(servo, goal, 100) == StatusError.DATA_RANGE
    run(servo, 0.3)
    assert abs(read(servo, "present_position") - stopped) <= 1
    assert write(servo, "bus_watchdog", 5) == StatusError.DATA_RANGE
    assert write(servo, "bus_watchdog", 0) == OK
    run(servo, 0.3)
    assert abs(read(servo, "present_position") - stopped) <= 1
    assert write(servo, goal, 100) == OK
    run(servo, 0.2)
    assert read(servo, "present_position") != stopped


def test_watchdog_sleeps_without_torque_and_is_fed_by_any_packet():
    servo = VirtualServo("xm430-w350")
    write(servo, "bus_watchdog", 1)
    run(servo, 0.5)
    assert read(servo, "bus_watchdog") == 1
    write(servo, "torque_enable", 1)
    for _ in range(20):
        run(servo, 0.015)
        servo.feed()
    assert read(servo, "bus_watchdog") == 1


def test_overload_takes_the_torque_until_a_reboot():
    motor = MOTORS["xm430-w350"]
    servo = VirtualServo("xm430-w350", plant=Gear(motor.inertia, motor.coulomb, stop=(-0.2, 0.2)))
    write(servo, "torque_enable", 1)
    write(servo, "goal_position", 3500)
    run(servo, 0.5)
    assert read(servo, "hardware_error_status") == 0 and read(servo, "present_current") > 600
    run(servo, 1.5)
    assert read(servo, "hardware_error_status") == 0x20 and read(servo, "torque_enable") == 0
    assert write(servo, "torque_enable", 1) == ALERT and read(servo, "torque_enable") == 0
    assert servo.drive.current == 0
    servo.execute(p.reboot(1))
    run(servo, 0.2)
    assert write(servo, "torque_enable", 1) == OK and read(servo, "hardware_error_status") == 0


def test_voltage_error_shuts_down_only_where_the_register_says():
    for model, torque in (("xm430-w350", 1), ("xl330-m288", 0)):
        servo = ready(model)
        servo.drive.supply = 3.0
        run(servo, 0.05)
        assert servo.get("hardware_error_status") == 0x01
        assert servo.get("torque_enable") == torque
        assert servo.execute(p.ping(1)).alert


def test_heat_follows_the_square_of_the_current():
    motor = MOTORS["xm430-w350"]
    servo = VirtualServo(
        "xm430-w350", plant=Gear(motor.inertia, stop=(-0.1, 0.1)), registers={"operating_mode": 0}
    )
    write(servo, "torque_enable", 1)
    write(servo, "goal_current", 400)
    run(servo, 20.0)
    share = (400 * 2.69e-3 / motor.stall_current) ** 2
    expected = 25 + motor.heating * share * (1 - exp(-20 / motor.thermal_time))
    assert servo.drive.temperature == pytest.approx(expected, rel=0.01)
    assert servo.drive.voltage < servo.drive.supply
    servo.drive.ambient = servo.drive.temperature = 90.0
    run(servo, 0.1)
    assert read(servo, "hardware_error_status") == 0x04 and read(servo, "torque_enable") == 0


# Whole-servo instructions.


@pytest.mark.parametrize(
    ("keep", "kept"), [("nothing", (1, 57_600)), ("id", (7, 57_600)), ("id and baud", (7, 1_000_000))]
)
def test_factory_reset(keep, kept):
    servo = VirtualServo("xm430-w350", 7, baud=1_000_000, registers={"drive_mode": 5, "homing_offset": 50})
    reply = servo.execute(p.factory_reset(7, keep))
    assert reply.id == 7 and reply.error == OK
    run(servo, 0.2)
    assert (servo.id, servo.baud) == kept
    assert read(servo, "drive_mode") == 0 and read(servo, "homing_offset") == 0


def test_broadcast_reset_of_everything_is_refused():
    servo = VirtualServo("xm430-w350", 7)
    servo.execute(p.factory_reset(p.BROADCAST, "nothing"))
    assert servo.id == 7 and servo.awake


def test_reg_write_waits_for_action():
    servo = ready()
    assert servo.execute(p.reg_write(1, 116, (2500).to_bytes(4, "little"))).error == OK
    assert read(servo, "registered_instruction") == 1 and read(servo, "goal_position") == 2048
    assert servo.execute(p.action()) is None
    assert read(servo, "goal_position") == 2500 and read(servo, "registered_instruction") == 0


def test_backup_brings_the_eeprom_back():
    servo = VirtualServo("xl430-w250", 3, registers={"homing_offset": 77})
    assert servo.execute(p.backup(3, "restore")).error == StatusError.RESULT_FAIL
    assert servo.execute(p.backup(3, "store")).error == OK
    assert read(servo, "backup_ready") == 1
    write(servo, "homing_offset", -5)
    assert servo.execute(p.backup(3, "restore")).error == OK
    run(servo, 0.2)
    assert read(servo, "homing_offset") == 77
    write(servo, "torque_enable", 1)
    assert servo.execute(p.backup(3, "store")).error == StatusError.RESULT_FAIL


def test_shadow_id_obeys_in_silence():
    servo = VirtualServo("xm430-w350", 1, registers={"secondary_id": 100})
    assert servo.answers_to(100) and not servo.answers_to(5)
    assert servo.execute(p.write(100, 65, b"\1")) is None and read(servo, "led") == 1
    assert servo.execute(p.ping(100)) is None
    servo.execute(p.write(100, 9, b"\0"))
    assert read(servo, "return_delay_time") == 250  # EEPROM is out of reach
    write(servo, "secondary_id", 255)
    assert not servo.answers_to(255)


def test_mode_change_resets_profiles_and_gains():
    servo = VirtualServo("xm430-w350")
    for name in ("profile_velocity", "profile_acceleration", "position_p_gain"):
        write(servo, name, 33)
    write(servo, "operating_mode", 4)
    assert [read(servo, n) for n in ("profile_velocity", "profile_acceleration", "position_p_gain")] == [
        0,
        0,
        800,
    ]


def test_given_registers_hold():
    servo = VirtualServo("xm430-w350", registers={"drive_mode": 4, "torque_enable": 1, "goal_position": 3000})
    run(servo, 2.0)
    assert read(servo, "drive_mode") == 4
    assert read(servo, "present_position") == pytest.approx(3000, abs=20)
    servo.execute(p.reboot(1))
    assert (servo.get("drive_mode"), servo.get("torque_enable")) == (4, 0)


def test_wrong_descriptions_are_refused():
    with pytest.raises(RegisterError, match="999 does not fit register 'return_delay_time'"):
        VirtualServo("xm430-w350", registers={"return_delay_time": 999})
    with pytest.raises(RegisterError, match="no register 'goal'"):
        VirtualServo("xm430-w350", registers={"goal": 1})
    with pytest.raises(HardwareError, match=r"no bit rate 123.*1,000,000"):
        VirtualServo("xm430-w350", baud=123)
    with pytest.raises(HardwareError, match="no servo model"):
        VirtualServo("xm999")
    assert trapezoid(0, 0, 1, speed=inf).duration == 0
