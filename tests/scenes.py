"""Scenes for tests: random ones, and their text as TOML."""

import json
from typing import Any

from hypothesis import strategies as st

# hinge and slide joints of each model
SCALARS = {
    "pendulum": ["hinge"],
    "double_pendulum": ["shoulder", "elbow"],
    "planar_2r": ["shoulder", "elbow"],
    "cart_pole": ["slide", "hinge"],
}
numbers = st.floats(-2.0, 2.0, allow_subnormal=False).map(lambda x: round(x, 3))
turns = st.tuples(numbers, numbers, numbers, numbers).filter(lambda q: sum(c * c for c in q) > 0.1)


def to_toml(data: dict[str, Any]) -> str:
    """A dict of plain values, dicts and lists as TOML text, dicts in lists of the top level as [[tables]]."""
    plain, tables = [], []
    for key, value in data.items():
        if isinstance(value, dict):
            tables.append(f"\n[{key}]\n" + "".join(f"{_key(k)} = {_value(v)}\n" for k, v in value.items()))
        elif isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
            for item in value:
                tables.append(f"\n[[{key}]]\n" + "".join(f"{k} = {_value(v)}\n" for k, v in item.items()))
        else:
            plain.append(f"{key} = {_value(value)}\n")
    return "".join([*plain, *tables])


def _key(name: str) -> str:
    return name if name.replace("_", "").isalnum() else json.dumps(name)


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    return json.dumps(value)


@st.composite
def placements(draw):
    """A placement as a scene has it: a position, and a rotation as quaternion, euler angles or not at all."""
    out: dict[str, Any] = {"position": draw(st.tuples(numbers, numbers, numbers))}
    kind = draw(st.sampled_from(["none", "rotation", "euler"]))
    if kind == "rotation":
        out["rotation"] = draw(turns)
    if kind == "euler":
        out["euler"] = draw(st.tuples(numbers, numbers, numbers))
    return out


@st.composite
def scenes(draw):
    """A scene of one or two models and a ball, as plain data."""
    data: dict[str, Any] = {
        "duration": draw(st.sampled_from([0.02, 0.05])),
        "angle": draw(st.sampled_from(["radian", "degree"])),
    }
    files = draw(st.lists(st.sampled_from(sorted(SCALARS)), min_size=1, max_size=2))
    named = len(files) > 1 or draw(st.booleans())
    data["models"] = [
        {"file": file, **({"name": f"m{i}"} if named else {}), **draw(placements())}
        for i, file in enumerate(files)
    ]
    joints = [(f"m{i}/" if named else "") + j for i, file in enumerate(files) for j in SCALARS[file]]
    roles = {j: draw(st.sampled_from(["keyed", "tracked", "passive"])) for j in joints}
    data["initial"] = {
        "position": {j: draw(numbers) for j in joints if roles[j] == "passive" and draw(st.booleans())},
        "velocity": {j: [draw(numbers)] for j in joints if roles[j] == "passive" and draw(st.booleans())},
    }
    data["roles"] = {"tracked": [j for j in joints if roles[j] == "tracked"]}
    data["keys"] = [
        {
            "joint": j,
            "times": [0, 0.03, 0.3],
            "values": [draw(numbers) for _ in range(3)],
            "curve": draw(st.sampled_from(["step", "linear", "auto", "natural", "clamped"])),
        }
        for j in joints
        if roles[j] != "passive"
    ]
    data["physics"] = {"gravity": draw(st.one_of(st.booleans(), st.tuples(numbers, numbers, numbers)))}
    if draw(st.booleans()):
        data["props"] = [{"name": "ball", "shape": "sphere", "size": [0.1], **draw(placements())}]
        data["forces"] = [{"body": "ball", "force": draw(st.tuples(numbers, numbers, numbers))}]
    if "tracked" in roles.values():
        data["controller"] = {"law": "pd", "period": 0.002, "frequency": draw(st.sampled_from([2, 5.5]))}
    return data
