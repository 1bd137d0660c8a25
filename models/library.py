"""Finding and loading robot models: built-in ones, files, and the robots of a data folder."""

import os
import warnings
from difflib import get_close_matches
from pathlib import Path

import mujoco
import numpy as np

from . import urdf
from .diagnose import captured_warnings, explain, listing, nonfinite_numbers
from .errors import ModelError, ModelWarning
from .naming import Kind, name_of

_BUILT_IN = Path(__file__).parent / "mjcf"
_EXTENSIONS = (".xml", ".urdf")


def names() -> tuple[str, ...]:
    """Names of the built-in models."""
    return tuple(sorted(path.stem for path in _BUILT_IN.glob("*.xml")))


def data_robots() -> dict[str, Path]:
    """Robots of the data folder by name: `PANTOGRAPH_DATA`, else `../shared/data` beside checkout or cwd."""
    folder = _data_folder()
    if folder is None:
        return {}
    files = sorted((folder / "robots").glob("*/*"))
    return {path.stem: path for path in files if path.suffix in _EXTENSIONS and path.stem != "scene"}


def find(name_or_path: str | Path, *, base: Path | None = None) -> Path:
    """File of a model.

    Looked for, in this order: a file of that path relative to `base` and to the working folder, a built-in
    name, a robot of the data folder.

    Raises:
        ModelError: nothing of that name; the message says where it looked, lists names and offers near ones.
    """
    asked = Path(name_or_path).expanduser()
    roots = [Path.cwd()] if base is None else [base.absolute(), Path.cwd()]
    candidates = list(dict.fromkeys(root / asked for root in roots))
    for path in candidates:
        if path.is_file():
            return path.resolve()
    named = {name: _BUILT_IN / f"{name}.xml" for name in names()}
    robots = data_robots()
    for known in (named, robots):
        if str(name_or_path) in known:
            return known[str(name_or_path)].resolve()
    for path in candidates:
        if path.is_dir():
            raise ModelError(
                f"{path} is a folder, not a model file; name a file in it: {listing(path, _EXTENSIONS)}"
            )
    raise ModelError(_not_found(str(name_or_path), candidates, tuple(named), tuple(robots)))


def load_spec(name_or_path: str | Path, *, base: Path | None = None) -> mujoco.MjSpec:
    """Editable description of a model (MJCF or URDF), compiled once and so known to be sound.

    Raises:
        ModelError: the model is missing or broken; says the file, the line if known, the thing and the fix.

    Warns:
        ModelWarning: something was changed or left out so that the model could be loaded, or MuJoCo warned.
    """
    return _load(find(name_or_path, base=base))[0]


def load_model(name_or_path: str | Path, *, base: Path | None = None) -> mujoco.MjModel:
    """Compiled model; raises and warns as `load_spec` does."""
    return _load(find(name_or_path, base=base))[1]


def _load(path: Path) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    text = _read(path)
    bad = nonfinite_numbers(path)
    if bad:
        raise ModelError("\n".join([f"{path}: every number of a model must be finite", *bad]))
    notes: list[str] = []
    with captured_warnings() as messages, warnings.catch_warnings(record=True) as fuller:
        warnings.simplefilter("always")  # MuJoCo's Python binding repeats some messages, with their details
        try:
            is_urdf = urdf.is_urdf(text)
            spec = urdf.parse(path, text, notes) if is_urdf else mujoco.MjSpec.from_file(str(path))
            model = spec.compile()
        except (ValueError, mujoco.FatalError) as error:
            raise explain(path, str(error)) from error
    detailed = [str(warning.message) for warning in fuller]
    plain = [message for message in messages if not any(text.startswith(message) for text in detailed)]
    for note in [*notes, *_upside_down(model), *detailed, *plain]:
        warnings.warn(f"{path}: {note}", ModelWarning, stacklevel=3)
    return spec, model


def _upside_down(model: mujoco.MjModel) -> list[str]:
    """MuJoCo silently takes limits whose lower bound is the greater for no limits."""
    notes = []
    limits: tuple[tuple[Kind, str, str], ...] = (
        ("joint", "range", "jnt_"),
        ("actuator", "ctrlrange", "actuator_ctrl"),
        ("actuator", "forcerange", "actuator_force"),
    )
    for kind, attribute, field in limits:
        bounds, limited = getattr(model, field + "range"), getattr(model, field + "limited")
        for index in np.flatnonzero((bounds[:, 0] > bounds[:, 1]) & (limited == 0)):
            low, high = bounds[index]
            notes.append(
                f"{kind} {name_of(model, kind, int(index))!r} has no limit: its {attribute} {low:g} {high:g} "
                "is upside down; write the lower bound first"
            )
    return notes


def _read(path: Path) -> str:
    if path.suffix == ".xacro":
        raise ModelError(
            f"{path}: xacro files are templates; expand it first: xacro {path.name} > {path.stem}.urdf"
        )
    if path.suffix.lower() not in _EXTENSIONS:
        raise ModelError(
            f"{path}: a model file ends in .xml (MJCF) or .urdf, not {path.suffix or 'without extension'!r}"
        )
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ModelError(f"{path}: not a text file in UTF-8 (byte {error.start}); is it XML?") from error
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}") from error
    if not text.strip():
        raise ModelError(f"{path}: the file is empty; a model is at least <mujoco><worldbody/></mujoco>")
    return text


def _data_folder() -> Path | None:
    if os.environ.get("PANTOGRAPH_DATA"):
        folders = [Path(os.environ["PANTOGRAPH_DATA"])]
    else:
        folders = [root.parent / "shared" / "data" for root in (Path(__file__).parents[1], Path.cwd())]
    return next((folder for folder in folders if (folder / "robots").is_dir()), None)


def _model_files(folder: Path) -> list[Path]:
    found = folder.iterdir() if folder.is_dir() else ()
    return [path for path in found if path.suffix.lower() in _EXTENSIONS]


def _not_found(asked: str, tried: list[Path], built_in: tuple[str, ...], robots: tuple[str, ...]) -> str:
    stem = Path(asked).stem if Path(asked).suffix in _EXTENSIONS else asked
    beside = {path.stem: path.name for path in _model_files(tried[0].parent)}
    known = {**beside, **{name: name for name in (*built_in, *robots)}}
    close = [known[name] for name in get_close_matches(stem, known, n=1)]
    lines = [f"no model {asked!r}" + (f" (did you mean {close[0]!r}?)" if close else "")]
    lines.append("built-in models: " + ", ".join(built_in))
    if robots:
        lines.append("robots of the data folder: " + ", ".join(robots))
    elif os.environ.get("PANTOGRAPH_DATA"):
        lines.append(f"PANTOGRAPH_DATA is {os.environ['PANTOGRAPH_DATA']!r}, which has no folder 'robots'")
    else:
        lines.append(
            "no data folder of further robots: set PANTOGRAPH_DATA to the folder that holds 'robots'"
        )
    for path in tried:
        lines.append(f"looked for the file {path}; that folder holds {listing(path.parent, _EXTENSIONS)}")
    return "\n".join(lines)
