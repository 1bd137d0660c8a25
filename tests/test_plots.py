import dataclasses

import matplotlib
import matplotlib._pylab_helpers
import numpy as np
import pytest
from pantograph.sim import PantographError, Scene, plot, run
from pantograph.sim.engines.interface import Event
from pantograph.sim.plots import figure

ARM = {
    "duration": 0.5,
    "angle": "degree",
    "models": [{"file": "arm6"}],
    "roles": {"tracked": ["elbow"]},
    "keys": [
        {"joint": "waist", "times": [0, 0.3, 1], "values": [0, 40, -20]},
        {"joint": "elbow", "times": [0, 0.5], "values": [20, 60]},
    ],
}


@pytest.fixture(scope="module")
def recording():
    return run(Scene(**ARM))


def lines(ax, *, marks=False):
    """Lines of a chart by label; those of keys with ``marks``."""
    drawn = [line for line in ax.lines if (line.get_marker() == "o") == marks and len(line.get_xdata()) > 2]
    return {line.get_label(): line for line in drawn}


def test_curves_are_those_of_the_recording(recording):
    q, v, tau, energy = figure(recording).axes
    m = recording.model
    assert len(lines(q)) == m.njnt
    for j in range(m.njnt):
        name = m.joint(j).name
        role = {"waist": "keyed", "elbow": "tracked"}.get(name, "passive")
        line = lines(q)[f"{name} ({role})"]
        np.testing.assert_array_equal(line.get_xdata(), recording.t)
        np.testing.assert_array_equal(line.get_ydata(), recording.q[:, j])
        assert (line.get_linestyle() == "--") == (role == "passive")
    for ax, array in ((v, recording.v), (tau, recording.tau)):
        drawn = [line.get_ydata() for line in ax.lines]
        np.testing.assert_array_equal(drawn, array.T)
    for name, array in (("kinetic", recording.kinetic), ("potential", recording.potential)):
        np.testing.assert_array_equal(lines(energy)[name].get_ydata(), array)
    np.testing.assert_array_equal(lines(energy)["total"].get_ydata(), recording.kinetic + recording.potential)


def test_keys_are_marked_where_they_are(recording):
    marks = [line for line in figure(recording).axes[0].lines if line.get_marker() == "o"]
    (waist, elbow) = sorted(marks, key=lambda line: len(line.get_xdata()), reverse=True)
    np.testing.assert_allclose(waist.get_xdata(), [0, 0.3])  # that at 1 s is after the end
    np.testing.assert_allclose(waist.get_ydata(), np.deg2rad([0, 40]))
    np.testing.assert_allclose(elbow.get_ydata(), np.deg2rad([20, 60]))
    on = np.interp(0.3, recording.t, recording.q[:, 0])
    assert waist.get_ydata()[1] == pytest.approx(on, abs=1e-3)


def test_axes_have_units(recording):
    labels = [ax.get_ylabel() for ax in figure(recording).axes]
    assert labels == ["position [rad]", "velocity [rad/s]", "drive force [N m]", "energy [J]"]
    assert figure(recording).axes[3].get_xlabel() == "time [s]"
    cart = run(Scene(duration=0.1, models=[{"file": "cart_pole"}]))
    assert figure(cart).axes[0].get_ylabel() == "position [rad or m]"
    assert figure(cart, joints=["slide"]).axes[0].get_ylabel() == "position [m]"


def test_only_named_joints_or_those_that_move_most():
    r = run(
        Scene(
            duration=0.2,
            models=[{"chain": {"links": 14, "joint": "hinge"}}],
            initial={"velocity": {"joint_14": 9}},
        )
    )
    drawn = [line.get_label() for line in figure(r).axes[0].lines]
    assert len(drawn) == 10
    reach = np.ptp(r.q, axis=0)
    most = {f"joint_{j + 1} (passive)" for j in np.argsort(-reach)[:10]}
    assert set(drawn) == most
    assert "4 joints that move less" in figure(r).get_suptitle()
    (one,) = figure(r, joints=["joint_2"]).axes[0].lines
    assert one.get_label() == "joint_2 (passive)"
    with pytest.raises(PantographError, match="no hinge or slide joint 'joint_99'"):
        figure(r, joints=["joint_99"])


def test_a_recording_without_scalar_joints_shows_its_energies():
    r = run(Scene(duration=0.2, props=[{"name": "ball", "shape": "sphere", "size": [0.1]}]))
    q, _, _, energy = figure(r).axes
    assert not q.lines
    np.testing.assert_array_equal(lines(energy)["kinetic"].get_ydata(), r.kinetic)


def test_the_names_of_the_joints_cover_no_curve(recording):
    chart = figure(recording)
    chart.canvas.draw()
    axes = chart.axes[0]
    legend, inside = axes.get_legend().get_window_extent(), axes.get_window_extent()
    assert legend.y0 >= inside.y1 - 1
    assert legend.x1 <= chart.bbox.x1
    assert legend.y1 <= chart.bbox.y1


def test_first_contacts_and_limits_are_marked():
    r = run(Scene(duration=0.5, models=[{"file": "cart_pole"}], initial={"velocity": {"slide": 5}}))
    (limit,) = [e for e in r.events if e.kind == "limit"][:1]
    verticals = [line.get_xdata()[0] for line in figure(r).axes[0].lines if len(line.get_xdata()) == 2]
    assert limit.t in verticals
    floor = {"name": "floor", "shape": "plane", "size": [3, 3], "fixed": True}
    ball = {"name": "ball", "shape": "sphere", "size": [0.1], "position": [0, 0, 0.2]}
    r = run(Scene(duration=0.5, props=[ball, floor]))
    verticals = [line.get_xdata()[0] for line in figure(r).axes[3].lines if len(line.get_xdata()) == 2]
    assert verticals == [e.t for e in r.events if e.kind == "contact"]
    # what bounces is marked at every bounce, what chatters once
    times = {"bouncing": [0.1, 0.2, 0.4], "chattering": [0.3, 0.302, 0.31, 0.33, 0.35]}
    events = [
        Event(t + later, kind, what)
        for what, begun in times.items()
        for t in begun
        for kind, later in (("contact", 0), ("contact end", 1e-3))
    ]
    r = dataclasses.replace(r, events=tuple(sorted(events, key=lambda e: e.t)))
    verticals = [line.get_xdata()[0] for line in figure(r).axes[3].lines if len(line.get_xdata()) == 2]
    assert verticals == [0.1, 0.2, 0.3, 0.4]


@pytest.mark.parametrize(("ending", "magic"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_files_are_what_their_ending_says(recording, tmp_path, ending, magic):
    path = plot(recording, tmp_path / "new" / f"p.{ending}")
    assert path.read_bytes().startswith(magic)


def test_what_cannot_be_plotted_is_said(recording, tmp_path):
    with pytest.raises(PantographError, match=r"cannot write the plot .*Format 'xyz' is not supported"):
        plot(recording, tmp_path / "p.xyz")
    (tmp_path / "file").touch()
    with pytest.raises(PantographError, match="cannot write the plot"):
        plot(recording, tmp_path / "file" / "p.png")

    short = dataclasses.replace(recording, t=recording.t[:1])
    with pytest.raises(PantographError, match="fewer than two samples"):
        plot(short, tmp_path / "p.png")


def test_plotting_needs_no_display_and_leaves_no_global_state(recording, tmp_path):
    before = matplotlib.get_backend()
    plot(recording, tmp_path / "p.png")
    assert matplotlib.get_backend() == before
    assert matplotlib._pylab_helpers.Gcf.get_num_fig_managers() == 0


def test_a_scene_with_goals_shows_how_far_it_is_from_them():
    goal = {
        "at": "tip",
        "times": [0, 0.5],
        "position": [[0.45, 0, 0.4], [3, 0, 0.4]],
        "rotation": [[0, 0, 0]] * 2,
    }
    shown = run(Scene(duration=0.5, models=[{"file": "arm6"}], goals=[goal]))
    ax = figure(shown).axes[4]
    drawn = {line.get_label(): line for line in ax.lines}
    for k, unit in enumerate(("m", "rad")):
        missed = np.maximum(shown.missed[:, 0, k], 1e-9)
        np.testing.assert_allclose(drawn[f"pose tip [{unit}]"].get_ydata(), missed)
    assert drawn["pose tip [m]"].get_ydata()[-1] > 1 and ax.get_yscale() == "log"
    assert "m or rad" in ax.get_ylabel()
