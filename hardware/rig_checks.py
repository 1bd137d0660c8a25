"""What contradicts itself between the tables of a rig file, found in the plain data to be told all at once.

Malformed items are the schema's business: whatever has the wrong type is passed over here.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ..sim.scene.mistakes import Mistake, Path_
from .errors import RegisterError, unknown
from .registers import ControlTable, control_table, model_names

Tables = list[dict[str, Any]]


def contradictions(data: dict[str, Any]) -> list[Mistake]:
    """Every contradiction of a rig file, as read from TOML."""
    return [*_servos(data), *_links(data), *_joints(data), *_ranges(data)]


def _servos(data: dict[str, Any]) -> Iterator[Mistake]:
    """Names and IDs given twice, models that do not exist or cannot do what is asked."""
    servos = _tables(data, "servos")
    for i, servo in enumerate(servos):
        for key in ("name", "id"):
            given = servo.get(key)
            if given is not None and given in [s.get(key) for s in servos[:i]]:
                yield Mistake(("servos", i, key), f"{given!r} is used by an earlier servo already")
        model = servo.get("model")
        if not isinstance(model, str):
            continue
        try:
            table = control_table(model)
        except RegisterError:
            names = model_names()
            yield Mistake(("servos", i, "model"), unknown("servo model", model, names, where="Pantograph"))
        else:
            yield from _abilities(i, servo, table, data.get("baud", 1_000_000))


def _abilities(i: int, servo: dict[str, Any], table: ControlTable, baud: Any) -> Iterator[Mistake]:
    if isinstance(baud, int) and baud not in table.bauds.values():
        known = ", ".join(f"{b:_}" for b in table.bauds.values())
        yield Mistake(("baud",), f"{table.model} has no bit rate {baud:_}; it has: {known}")
    if servo.get("current") is not None and 5 not in table.modes:
        able = ", ".join(n for n in model_names() if 5 in control_table(n).modes)
        what = f"{table.model} does not control current; these do: {able}"
        yield Mistake(("servos", i, "current"), what)


def _links(data: dict[str, Any]) -> Iterator[Mistake]:
    """Servos that joints name: existing, and each once."""
    names = [n for s in _tables(data, "servos") if isinstance(n := s.get("name"), str)]
    used: dict[str, str] = {}
    for place, servo, joint in _mentions(data):
        if servo not in names:
            yield Mistake(place, unknown("servo", servo, names, where="this rig"))
        elif servo in used:
            yield Mistake(place, f"servo {servo!r} moves joint {used[servo]!r} already")
        used[servo] = joint
    for i, servo_ in enumerate(_tables(data, "servos")):
        name = servo_.get("name")
        if isinstance(name, str) and name not in used:
            what = f"servo {name!r} moves no joint; name it in one, or leave it out"
            yield Mistake(("servos", i), what)


def _mentions(data: dict[str, Any]) -> Iterator[tuple[Path_, str, str]]:
    """(place, servo, joint) of every mention of a servo by a joint."""
    for i, j in enumerate(_tables(data, "joints")):
        joint = str(j.get("joint"))
        if isinstance(j.get("servo"), str):
            yield ("joints", i, "servo"), j["servo"], joint
        for k, d in enumerate(_tables(j, "servos")):
            if isinstance(d.get("servo"), str):
                yield ("joints", i, "servos", k), d["servo"], joint
    for i, d in enumerate(_tables(data, "differentials")):
        joints = "/".join(_words(d, "joints"))
        for k, servo in enumerate(_words(d, "servos")):
            yield ("differentials", i, "servos", k), servo, joints


def _joints(data: dict[str, Any]) -> Iterator[Mistake]:
    """Joints given twice, without a servo, or only in a differential."""
    names = [j.get("joint") for j in _tables(data, "joints")]
    differentials = _tables(data, "differentials")
    coupled = [j for d in differentials for j in _words(d, "joints")]
    for i, joint in enumerate(_tables(data, "joints")):
        name = names[i]
        if name is not None and name in names[:i]:
            yield Mistake(("joints", i, "joint"), f"joint {name!r} stands here twice")
        if not (joint.get("servo") or joint.get("servos") or name in coupled):
            yield Mistake(("joints", i), f'no servo moves joint {name!r}; add servo = "..."')
    for i, d in enumerate(differentials):
        for k, name in enumerate(_words(d, "joints")):
            if name not in names:
                what = f"joint {name!r} needs a table [[joints]] of its own"
                yield Mistake(("differentials", i, "joints", k), what)


def _ranges(data: dict[str, Any]) -> Iterator[Mistake]:
    """Ranges that do not rise."""
    for key in ("servos", "joints"):
        for i, item in enumerate(_tables(data, key)):
            match item.get("range"):
                case [int() | float() as low, int() | float() as high] if low >= high:
                    yield Mistake((key, i, "range"), f"range must rise: [{low:g}, {high:g}]")


def _tables(data: dict[str, Any], key: str) -> Tables:
    value = data.get(key)
    return [v if isinstance(v, dict) else {} for v in value] if isinstance(value, list) else []


def _words(data: dict[str, Any], key: str) -> list[str]:
    value = data.get(key)
    return [v for v in value if isinstance(v, str)] if isinstance(value, list) else []
