import dataclasses
import io
import json
import stat
import zipfile

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pantograph.sim import ErrorEstimate, Recording, RecordingError, Scene, load, run
from pantograph.sim.engines.interface import Event
from pantograph.sim.recording import VERSION, model_to_bytes

ARRAYS = [f.name for f in dataclasses.fields(Recording) if "NDArray" in str(f.type) or f.type == "Array"]
any_bits = st.integers(0, 2**64 - 1).map(lambda bits: float(np.uint64(bits).view(np.float64)))
text = st.text(max_size=20)


@pytest.fixture(scope="module")
def recording():
    scene = Scene(
        title="two",
        duration=0.2,
        models=[{"file": "pendulum"}],
        props=[{"name": "ball", "shape": "sphere", "size": [0.1], "position": [1, 0, 0.12]}],
        roles={"tracked": ["hinge"]},
        keys=[{"joint": "hinge", "times": [0, 1], "values": [0, 1]}],
    )
    r = run(scene, error=True)
    assert r.events
    assert np.isfinite(r.error.trusted_until)
    return r


@pytest.fixture(scope="module")
def saved(recording, tmp_path_factory):
    return recording.save(tmp_path_factory.mktemp("saved") / "two.npz").read_bytes()


def assert_identical(one, other):
    """Same bits, types and shapes in every field."""
    for f in dataclasses.fields(one):
        a, b = getattr(one, f.name), getattr(other, f.name)
        assert type(a) is type(b), f.name
        if isinstance(a, np.ndarray):
            assert (a.dtype, a.shape) == (b.dtype, b.shape), f.name
            assert a.tobytes() == b.tobytes(), f.name
        elif isinstance(a, ErrorEstimate):
            assert_identical(a, b)
        elif isinstance(a, float):
            assert np.float64(a).tobytes() == np.float64(b).tobytes(), f.name
        else:
            assert a == b, f.name


def test_a_run_is_loaded_as_it_was_saved(recording, saved, tmp_path):
    assert len(ARRAYS) == 15
    (tmp_path / "r.npz").write_bytes(saved)
    assert_identical(recording, load(tmp_path / "r.npz"))


@st.composite
def contents(draw, base):
    """The recording ``base`` with arrays of any bits, NaN payloads included, and any texts."""
    n, m = draw(st.integers(0, 4)), draw(st.integers(0, 3))
    parts = {}
    for name in ARRAYS:
        now = getattr(base, name)
        rows = {"tick": m, "keye": None, "trac": None}.get(name[:4], n)
        shape = now.shape if rows is None else (rows, *now.shape[1:])
        parts[name] = draw(arrays(now.dtype, shape, elements=any_bits if now.dtype == float else None))
    events = draw(st.lists(st.builds(Event, st.floats(allow_nan=False), text, text), max_size=3))
    error = draw(
        st.none()
        | st.builds(
            ErrorEstimate,
            arrays(np.float64, n, elements=any_bits),
            arrays(np.float64, n, elements=any_bits),
            st.integers(1, 9),
            st.floats(allow_nan=False),
            st.floats(0, 1e9),
            st.integers(0, 10**12),
        )
    )
    return dataclasses.replace(
        base,
        **parts,
        events=tuple(events),
        error=error,
        message=draw(text),
        notes=tuple(draw(st.lists(text))),
    )


@given(st.data())
@settings(max_examples=60)
def test_any_content_is_loaded_bit_for_bit(recording, tmp_path_factory, data):
    r = data.draw(contents(recording))
    assert_identical(r, load(r.save(tmp_path_factory.getbasetemp() / "any.npz")))


def test_a_file_torn_anywhere_is_said_to_be_torn(saved, tmp_path):
    path = tmp_path / "torn.npz"
    for n in range(0, len(saved), 10):
        path.write_bytes(saved[:n])
        with pytest.raises(RecordingError, match="is torn" if n > 2 else "is not a recording"):
            load(path)


def test_a_flipped_bit_is_noticed_or_does_no_harm(recording, saved, tmp_path):
    path, rng, noticed = tmp_path / "flipped.npz", np.random.default_rng(3), 0
    entries = zipfile.ZipFile(io.BytesIO(saved))
    heads = [i for e in entries.infolist() for i in range(e.header_offset, e.header_offset + 120)]
    places = np.concatenate([rng.choice(heads, 300), rng.integers(entries.start_dir, len(saved), 300)])
    for i in np.concatenate([places, rng.integers(0, len(saved), 200)]):
        flipped = bytearray(saved)
        flipped[i] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        try:
            assert_identical(recording, load(path))
        except RecordingError:
            noticed += 1
    assert noticed > 400


def repacked(saved, change):
    """The file with its header changed."""
    with np.load(io.BytesIO(saved)) as archive:
        parts = {name: archive[name] for name in archive.files}
    header = json.loads(parts["header"].tobytes())
    change(header, parts)
    parts["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    out = io.BytesIO()
    np.savez(out, **parts)
    return out.getvalue()


def archive(**files):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as z:
        for name, content in files.items():
            z.writestr(name, content)
    return out.getvalue()


def npz(**parts):
    out = io.BytesIO()
    np.savez(out, **parts)
    return out.getvalue()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is not a recording"),
        (b"duration = 1\n", "is not a recording; recordings are .npz files made by 'pantograph run'"),
        (b"PK", "is torn"),
        (b"PK\x03\x04" + bytes(500), "is torn"),
        (archive(), "is a .npz file, but no recording"),
        (archive(a="text"), "is a .npz file, but no recording"),
        (npz(q=np.zeros(3)), "is a .npz file, but no recording"),
        (npz(header=np.zeros(3)), "is a .npz file, but no recording"),
        (npz(header=np.frombuffer(b"[1, 2]", np.uint8)), "is a .npz file, but no recording"),
        (npz(header=np.frombuffer(b'{"magic": "else"}', np.uint8)), "is a .npz file, but no recording"),
        (npz(header=np.array([{}], dtype=object)), "is torn"),
    ],
)
def test_foreign_files(content, says, tmp_path):
    path = tmp_path / "foreign.npz"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=says) as error:
        load(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda h, _: h.update(version=VERSION + 1),
            f"is of format {VERSION + 1}; .* reads {VERSION}: update",
        ),
        (lambda h, _: h.update(version="x"), "is of format x"),
        (lambda h, _: h.pop("version"), "is of format None"),
        (lambda h, _: h.pop("stats"), "lacks a part of a recording: .*'stats'"),
        (lambda h, _: h.update(mood="good"), "lacks a part of a recording: .*'mood'"),
        (lambda h, _: h.update(events=[[1]]), "lacks a part"),
        (lambda h, _: h.update(error=3), "lacks a part"),
        (lambda _, parts: parts.pop("tau"), "lacks a part of a recording: .*'tau'"),
        (lambda _, parts: parts.pop("model_bytes"), "lacks a part of a recording: 'model_bytes'"),
        (lambda _, parts: parts.pop("error_angle"), "lacks a part of a recording: 'error_angle'"),
    ],
)
def test_other_versions_and_missing_parts(saved, change, says, tmp_path):
    path = tmp_path / "other.npz"
    path.write_bytes(repacked(saved, change))
    with pytest.raises(RecordingError, match=says):
        load(path)


def test_missing_files_and_folders(saved, tmp_path):
    (tmp_path / "near.npz").write_bytes(saved)
    with pytest.raises(RecordingError, match=r"no recording .*far.npz; recordings in .*: near.npz"):
        load(tmp_path / "far.npz")
    with pytest.raises(RecordingError, match=r"cannot read .*: Is a directory"):
        load(tmp_path)


def test_what_cannot_be_written_is_said(recording, tmp_path):
    (tmp_path / "file").write_text("here")
    with pytest.raises(
        RecordingError, match=r"cannot write .*: Not a directory|cannot write .*: File exists"
    ):
        recording.save(tmp_path / "file" / "r.npz")
    with pytest.raises(RecordingError, match="it is a folder; name a file in it"):
        recording.save(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("failure", "raised"),
    [(OSError(28, "No space left on device"), RecordingError), (KeyboardInterrupt(), KeyboardInterrupt)],
)
def test_a_failed_save_leaves_the_old_file(recording, saved, tmp_path, monkeypatch, failure, raised):
    path = tmp_path / "r.npz"
    path.write_bytes(saved)

    def half(file, **_):
        file.write(b"PK half a file")
        raise failure

    monkeypatch.setattr(np, "savez_compressed", half)
    with pytest.raises(raised):
        recording.save(path)
    assert path.read_bytes() == saved
    assert [p.name for p in tmp_path.iterdir()] == ["r.npz"]


def test_who_reads_the_old_file_is_not_disturbed_by_a_new_one(recording, saved, tmp_path):
    path = tmp_path / "r.npz"
    path.write_bytes(b"the old file")
    with path.open("rb") as reader:
        recording.save(path)
        assert reader.read() == b"the old file"
    assert path.read_bytes() == saved


def test_saving_makes_folders_and_files_that_others_may_read(recording, tmp_path):
    path = recording.save(tmp_path / "a" / "b" / "r.npz")
    assert path == tmp_path / "a" / "b" / "r.npz"
    (tmp_path / "plain").touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


def test_arrays_are_read_only(recording, saved, tmp_path):
    (tmp_path / "r.npz").write_bytes(saved)
    for r in (recording, load(tmp_path / "r.npz")):
        for name in ARRAYS:
            assert not getattr(r, name).flags.writeable, name
        for name in ("angle", "length"):
            assert not getattr(r.error, name).flags.writeable, name
        with pytest.raises(ValueError, match="read-only"):
            r.q[0, 0] = 1.0
        with pytest.raises(dataclasses.FrozenInstanceError):
            r.q = np.zeros(3)


def test_the_model_comes_back_whole(recording, saved, tmp_path):
    (tmp_path / "r.npz").write_bytes(saved)
    model = load(tmp_path / "r.npz").model
    assert model_to_bytes(model) == recording.model_bytes
    assert model.joint("hinge").id == 0
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert data.time > 0


def test_a_model_of_another_mujoco_is_refused_but_its_arrays_are_read(saved, tmp_path):
    path = tmp_path / "old.npz"
    path.write_bytes(repacked(saved, lambda h, _: h["versions"].update(mujoco="3.2.1")))
    r = load(path)
    assert len(r.t) == len(r.q)
    with pytest.raises(RecordingError, match=rf"model of MuJoCo 3.2.1, here is {mujoco.__version__}"):
        _ = r.model
