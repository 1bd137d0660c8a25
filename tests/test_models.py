"""The built-in models and the chain: laws of mechanics, symmetry, and closed forms they must reproduce."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph import models
from scipy.linalg import eigvals, solve_continuous_are

NAMES = models.names()
MODELS = {name: models.load_model(name) for name in NAMES}
STANDING = ("puppet", "quadruped")
SEEDS = st.integers(0, 2**32 - 1)


def fresh(name: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    return MODELS[name], mujoco.MjData(MODELS[name])


def scatter(model: mujoco.MjModel, data: mujoco.MjData, seed: int) -> None:
    """Random configuration and velocity, joint limits ignored."""
    rng = np.random.default_rng(seed)
    mujoco.mj_integratePos(model, data.qpos, rng.uniform(-2, 2, model.nv), 1)
    data.qvel[:] = rng.normal(size=model.nv)
    mujoco.mj_forward(model, data)


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return M


def run(model: mujoco.MjModel, data: mujoco.MjData, duration: float) -> None:
    for _ in range(round(duration / model.opt.timestep)):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)


def energy(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    return float(data.energy.sum())


def assert_sound(data: mujoco.MjData) -> None:
    assert [warning.number for warning in data.warning] == [0] * len(data.warning)
    assert np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all() and np.isfinite(data.qacc).all()


@pytest.mark.parametrize("name", NAMES)
def test_left_alone_it_runs_without_warning_and_gains_no_energy(name):
    model, data = fresh(name)
    mujoco.mj_forward(model, data)
    start = energy(model, data)
    run(model, data, 0.5)
    assert_sound(data)
    # Servos hold the zero pose: they may lift sagging limbs by a hair.
    assert energy(model, data) <= start + 1e-3 * model.body_mass.sum()


@pytest.mark.parametrize("name", NAMES)
def test_drawn_parts_and_floor(name):
    model, _ = fresh(name)
    floor = models.lookup(model, "geom", "floor")
    assert model.geom_type[floor] == mujoco.mjtGeom.mjGEOM_PLANE
    assert (model.geom_size[floor, :2] > 0).all(), "finite, so that it can be filmed with its edge"
    for kind in ("body", "joint", "geom", "site", "actuator"):
        for index, shown in enumerate(models.names_of(model, kind)):
            assert shown != f"{kind}{index}", f"unnamed {kind}"


@pytest.mark.parametrize("name", STANDING)
def test_stands_still_on_its_own_servos(name):
    model, data = fresh(name)
    mujoco.mj_forward(model, data)
    height = data.qpos[2]
    run(model, data, 2.0)
    assert abs(data.qpos[2] - height) < 0.01
    assert abs(data.qpos[3]) > np.cos(0.05), "no more than 0.1 rad of tilt"


@pytest.mark.parametrize("name", STANDING)
@pytest.mark.parametrize("seed", range(3))
def test_dropped_tumbling_it_comes_to_lie(name, seed):
    model, data = fresh(name)
    rng = np.random.default_rng(seed)
    data.qpos[2] = 1.2
    data.qpos[3:7] = rng.normal(size=4)
    data.qvel[:6] = rng.normal(size=6)
    mujoco.mj_forward(model, data)
    start = energy(model, data)
    for _ in range(10):
        run(model, data, 0.2)
        assert_sound(data)
        assert energy(model, data) < start + 1e-2 * abs(start)
    assert np.abs(data.qvel[:3]).max() < 0.5
    assert data.geom_xpos[1:, 2].min() > -0.05, "nothing has sunk into the floor"


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_mass_matrix_is_that_of_bodies_with_mass(name, seed):
    model, data = fresh(name)
    scatter(model, data, seed)
    M = mass_matrix(model, data)
    np.testing.assert_allclose(M, M.T, atol=1e-14)
    assert np.linalg.eigvalsh(M).min() > 0
    if name in STANDING:  # pushing a free body anywhere along a line moves all of its mass
        np.testing.assert_allclose(M[:3, :3], model.body_mass.sum() * np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("name", "mass"), [("pendulum", 1.0), ("double_pendulum", 2.0), ("cart_pole", 0.7), ("planar_2r", 6.1)]
)
def test_total_mass(name, mass):
    assert MODELS[name].body_mass.sum() == pytest.approx(mass, rel=1e-14)


@pytest.mark.parametrize("name", ["pendulum", "double_pendulum", "cart_pole", "planar_2r"])
@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_pendulums_touch_nothing(name, seed):
    model, data = fresh(name)
    scatter(model, data, seed)
    assert data.ncon == 0


@pytest.mark.parametrize("name", ["arm6", *STANDING])
@settings(max_examples=30, deadline=None)
@given(seed=SEEDS)
def test_limbs_of_one_robot_do_not_collide(name, seed):
    model, data = fresh(name)
    scatter(model, data, seed)
    if name in STANDING:
        data.qpos[2] += 5
        mujoco.mj_forward(model, data)
    floor = models.lookup(model, "geom", "floor")
    for contact in data.contact:
        pair = [models.name_of(model, "geom", int(i)) for i in contact.geom]
        assert floor in contact.geom or any(geom.startswith("scarf_") for geom in pair), pair


def test_scarf_of_the_puppet_is_passive_and_lies_on_its_back():
    spec = models.load_spec("puppet")
    spec.delete(spec.joint("root"))
    spec.body("pelvis").pos[2] = 3
    model = spec.compile()
    data = mujoco.MjData(model)
    scarf = [j for j, name in enumerate(models.joint_names(model)) if name.startswith("scarf_")]
    assert len(scarf) == 6 and (model.jnt_type[scarf] == mujoco.mjtJoint.mjJNT_BALL).all()
    assert not set(scarf) & set(model.actuator_trnid[:, 0])
    damping = [model.dof_damping[model.jnt_dofadr[j]] for j in scarf]
    assert min(damping) > 0 and max(damping) < 0.01
    # Gravity turned forwards presses it on the coat: it must come to rest there, not inside.
    model.opt.gravity[:] = 9.81 * np.sin(0.4), 0, -9.81 * np.cos(0.4)
    run(model, data, 2.0)
    assert data.ncon > 0
    assert min(contact.dist for contact in data.contact) > -5e-3
    assert np.abs(data.qvel).max() < 0.5


def mirrored_state(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Equal angles with left and right exchanged; balls and the base reflected in the plane y = 0."""
    out = qpos.copy()
    names = models.joint_names(model)
    for j, name in enumerate(names):
        source, target = model.jnt_qposadr[j], model.jnt_qposadr[names.index(swap(name))]
        if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
            out[target : target + 7] = qpos[source : source + 7] * [1, -1, 1, 1, -1, 1, -1]
        elif model.jnt_type[j] == mujoco.mjtJoint.mjJNT_BALL:
            out[target : target + 4] = qpos[source : source + 4] * [1, -1, 1, -1]
        else:
            out[target] = qpos[source]
    return out


def swap(name: str) -> str:
    return name.replace("left", "?").replace("right", "left").replace("?", "right")


def mirror_image(
    model: mujoco.MjModel, data: mujoco.MjData
) -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    """Centre of mass, inertia in world axes and mass of every body but the scarf's."""
    image = {}
    for i, name in enumerate(models.names_of(model, "body")):
        if not name.startswith("scarf"):
            R = data.ximat[i].reshape(3, 3)
            image[name] = (data.xipos[i].copy(), R @ np.diag(model.body_inertia[i]) @ R.T, model.body_mass[i])
    return image


@pytest.mark.parametrize("name", STANDING)
@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_equal_angles_left_and_right_mirror_the_pose(name, seed):
    model, data = fresh(name)
    scatter(model, data, seed)
    here = mirror_image(model, data)
    data.qpos[:] = mirrored_state(model, data.qpos)
    mujoco.mj_forward(model, data)
    there = mirror_image(model, data)
    S = np.diag([1.0, -1.0, 1.0])
    for body, (com, inertia, mass) in here.items():
        com2, inertia2, mass2 = there[swap(body)]
        np.testing.assert_allclose(S @ com, com2, atol=1e-12, err_msg=body)
        np.testing.assert_allclose(S @ inertia @ S, inertia2, atol=1e-12, err_msg=body)
        assert mass == mass2


@pytest.mark.parametrize("name", STANDING)
def test_limits_and_servos_are_alike_left_and_right(name):
    model, _ = fresh(name)
    for j, joint in enumerate(models.joint_names(model)):
        twin = models.lookup(model, "joint", swap(joint))
        np.testing.assert_array_equal(model.jnt_range[j], model.jnt_range[twin])
    for a, actuator in enumerate(models.names_of(model, "actuator")):
        twin = models.lookup(model, "actuator", swap(actuator))
        for field in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"):
            np.testing.assert_array_equal(getattr(model, field)[a], getattr(model, field)[twin])


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS)
def test_wrist_of_arm6_is_spherical(seed):
    model, data = fresh("arm6")
    scatter(model, data, seed)
    roll, pitch, tool = (
        models.lookup(model, "joint", n) for n in ("forearm_roll", "wrist_pitch", "tool_roll")
    )
    p_W = data.xanchor[pitch]
    for joint in (roll, tool):
        axis = data.xaxis[joint]
        distance = np.linalg.norm(np.cross(p_W - data.xanchor[joint], axis))
        assert distance < 1e-14
    assert abs(data.xaxis[pitch] @ data.xaxis[roll]) < 1e-14
    assert abs(data.xaxis[pitch] @ data.xaxis[tool]) < 1e-14


def test_planar_2r_reaches_where_the_closed_form_says():
    model, data = fresh("planar_2r")
    data.qpos[:] = -0.0739531788805312790, 1.38853897167576753
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.site("tip").xpos, [1.2, 0, 2 + 0.7], atol=1e-15)


def test_pendulum_is_the_simple_pendulum():
    """IFToMM A01: from horizontal at rest, P(0.5)."""
    model = models.load_model("pendulum")
    data = mujoco.MjData(model)
    model.opt.timestep = 1e-3
    data.qpos[0] = -np.pi / 2
    run(model, data, 0.5)
    p = data.site("tip").xpos - [0, 0, 1.6]
    np.testing.assert_allclose(p[[0, 2]], [-0.3910487915505463877, -0.9203699487851922038], atol=1e-10)


def test_double_pendulum_is_that_of_point_masses():
    """At rest from 120 and 90 degrees: angles from down at 1 s, in 25 digits from notes/references."""
    model = models.load_model("double_pendulum")
    data = mujoco.MjData(model)
    model.opt.timestep = 1e-3
    data.qpos[:] = np.deg2rad([120, 90 - 120])
    run(model, data, 1.0)
    np.testing.assert_allclose(
        [data.qpos[0], data.qpos.sum()], [-0.41915799685328908, -1.02402322843677553], atol=1e-8
    )


def test_cart_pole_has_the_gains_of_the_tutorial():
    """LQR of the CTMS tutorial, Q = diag(5000, 0, 100, 0), R = 1."""
    model = models.load_model("cart_pole")
    data = mujoco.MjData(model)
    # Linear dynamics at the upright pose, continuous time; g of the tutorial.
    model.opt.gravity[2] = -9.8
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    h = 1e-6
    for k in range(4):
        for sign in (1, -1):
            mujoco.mj_resetData(model, data)
            state = np.zeros(4)
            state[k] = sign * h
            data.qpos[:], data.qvel[:] = state[:2], state[2:]
            mujoco.mj_forward(model, data)
            A[2:, k] += sign * data.qacc / (2 * h)
    mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    B = np.concatenate([np.zeros(2), np.linalg.solve(mass_matrix(model, data), [1.0, 0.0])])[:, None]
    K = B.T @ solve_continuous_are(A, B, np.diag([5000.0, 100, 0, 0]), np.eye(1))
    expected = [-70.7106781186547524, 105.529781916036666, -37.8344539934957775, 20.9238437492099308]
    np.testing.assert_allclose(K[0], expected, rtol=1e-6)


def frequencies(model: mujoco.MjModel) -> np.ndarray:
    """Natural frequencies about the hanging pose, ascending [rad/s]."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    M, rest, K, h = mass_matrix(model, data), data.qpos.copy(), np.zeros((model.nv, model.nv)), 1e-5
    for k in range(model.nv):
        for sign in (1, -1):
            data.qpos[:] = rest
            mujoco.mj_integratePos(model, data.qpos, np.eye(model.nv)[k], sign * h)
            mujoco.mj_forward(model, data)
            K[:, k] += sign * data.qfrc_bias / (2 * h)
    return np.sqrt(np.sort(np.abs(eigvals(K, M))))


@pytest.mark.parametrize("joint", ["hinge", "ball"])
@pytest.mark.parametrize(
    ("n", "lowest"), [(2, 3.39015190017200780), (5, 3.59550186791424316), (10, 3.67662065761784941)]
)
def test_hanging_chain_has_the_closed_modes(joint, n, lowest):
    found = frequencies(models.chain(n, joint=joint, point_masses=True).compile())
    if joint == "ball":  # the n twists move nothing; every swing exists in two planes
        swings = found[n:]
        np.testing.assert_allclose(swings[0::2], swings[1::2], rtol=1e-6)
        found = swings[0::2]
    assert found[0] == pytest.approx(lowest, rel=3e-9)


@settings(max_examples=30, deadline=None)
@given(
    n=st.integers(1, 12),
    length=st.floats(0.1, 5),
    mass=st.floats(0.01, 50),
    joint=st.sampled_from(["ball", "hinge"]),
    fixed=st.booleans(),
    points=st.booleans(),
)
def test_chain_has_the_length_mass_and_joints_asked_for(n, length, mass, joint, fixed, points):
    model = models.chain(
        n, length=length, mass=mass, joint=joint, fixed=fixed, point_masses=points, damping=0.1
    ).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.site("tip").xpos, [0, 0, -length], atol=1e-12)
    assert model.body_mass.sum() == pytest.approx(mass)
    per_joint = 3 if joint == "ball" else 1
    assert model.nv == n * per_joint if fixed else model.nv == 6 + (n - 1) * per_joint
    ends = np.linspace(0, -length, n + 1)
    centre = ends[1:].mean() if points else ends.mean()
    assert data.subtree_com[1][2] == pytest.approx(centre)
    np.testing.assert_array_equal(model.dof_damping, 0.1 * (np.arange(model.nv) >= (0 if fixed else 6)))


def test_chain_lists_every_mistake():
    with pytest.raises(
        models.ModelError, match=r"n = 0.*length = -1.*mass = nan.*damping = -2.*joint = 'rope'"
    ):
        models.chain(0, length=-1, mass=float("nan"), damping=-2, joint="rope")
