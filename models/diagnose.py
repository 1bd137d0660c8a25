"""From the C library's messages to errors a person can act on: file, line, thing, fix."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from xml.parsers import expat

import mujoco

from .errors import ModelError

_MESHES = (".stl", ".obj", ".msh")
_PICTURES = (".png", ".ktx")

# What MuJoCo says, and what a person can do about it.
_FIXES = (
    (
        r"mass and inertia of moving bodies",
        "a body that moves needs mass: give it a geom with mass or an <inertial mass=... diaginertia=...>, "
        "or remove its joints",
    ),
    (
        r"inertia must satisfy A \+ B >= C",
        "no real body has these moments of inertia; correct them, or let "
        '<compiler balanceinertia="true"/> replace them by their mean',
    ),
    (r"mass, inertia or density are negative", "masses, inertias and densities are positive"),
    (r"_decoder", "the file is damaged or not of the kind that its ending says"),
    (r"repeated default class", "give the default classes different names"),
    (r"repeated name", "names are unique within one kind: rename one of them"),
    (
        r"not found in|unknown transmission target|unknown element",
        "names are case-sensitive; define it, or correct the reference",
    ),
    (r"already included", "a file may be included once, and not by itself"),
    (r"does not have enough data|has too much data", "give exactly as many numbers as the attribute takes"),
    (r"bad format in attribute", "the attribute takes numbers separated by spaces"),
    (r"invalid keyword", "the attribute takes one of a few words, in lower case"),
    (r"range\[0\] should be smaller", "write the lower bound first"),
    (r"free joint can only be used on top level", "put the body directly into <worldbody>"),
    (r"must be positive in geom|nan size", "every size of a geom is a positive number"),
    (r"invalid qpos size|invalid qvel size|invalid ctrl size", "a keyframe has one number per coordinate"),
    (
        r"URDF joint parent or child missing",
        "a joint needs <parent link=.../> and <child link=.../> that exist",
    ),
    (r"zero quaternion", 'the identity rotation is quat="1 0 0 0"'),
)


@contextmanager
def captured_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings instead of letting it write them to MUJOCO_LOG.TXT in the working folder."""
    messages: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(messages.append)
    try:
        yield messages
    finally:
        mujoco.set_mju_user_warning(before)


def listing(folder: Path, extensions: tuple[str, ...]) -> str:
    """Files of these extensions in a folder, as words for a message."""
    if not folder.is_dir():
        return "nothing (no such folder)"
    found = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in extensions)
    if len(found) > 12:
        found = [*found[:12], f"... ({len(found)} in all)"]
    return ", ".join(found) or "no " + " or ".join(extensions)


def explain(path: Path, message: str) -> ModelError:
    """Error for what MuJoCo said (`message`) about the model file `path`."""
    if "Error=XML_ERROR" in message:
        return ModelError(_syntax(path))
    root = re.search(r"Unrecognized XML model type: '(.*)'", message)
    if root:
        return ModelError(
            f"{path}: not a robot model: it starts with <{root[1]}>; "
            "MJCF starts with <mujoco>, URDF with <robot>"
        )
    missing = re.search(r"Error opening file '(.*?)'", message)
    if missing:
        return ModelError(_missing(path, missing[1]))
    what = (
        re.sub(r"^((XML )?Error: )+", "", message.strip()).split("\n")[0].removeprefix("Schema violation: ")
    )
    file, line, tag = _place(path, message, what)
    where = f"{file}{f':{line}' if line else ''}"
    name = re.search(r"Element name '(.+?)'", message)
    if name and f"'{name[1]}'" not in what:
        what += f" ({name[1]!r})"
    if what == "unrecognized element":
        parent = _parent(file, line, tag)
        what = f"unknown element <{tag}>" + (f" in <{parent}>" if parent else "")
        known = _schema()[0].get(parent, set()) if parent else set(_schema()[1])
        fix = [_suggest(tag, known, f"<{parent}> takes" if parent else "MJCF knows")]
    elif what.startswith("unrecognized attribute"):
        fix = [_suggest(what.split("'")[1], _schema()[1].get(tag, set()), f"<{tag}> takes")]
    else:
        repeated = re.search(r"repeated name '(.+?)'", what)
        if repeated:
            places = [str(n) for n, text in _lines(file) if f'name="{repeated[1]}"' in text]
            what += f" (on lines {', '.join(places)})" if len(places) > 1 else ""
        fix = [fix for pattern, fix in _FIXES if re.search(pattern, what)][:1]
    return ModelError("\n".join([f"{where}: {what}", *_source(file, line), *fix]))


def nonfinite_numbers(path: Path) -> list[str]:
    """Lines of a model file and its includes that hold NaN or infinity; bounds may be infinite."""
    found = []
    for file in _files(path):
        for number, line in _lines(file):
            for attribute, value in re.findall(r"([\w:]+)\s*=\s*[\"']([^\"']*)[\"']", line):
                words = {word.lower().lstrip("+-") for word in value.split()}
                bound = attribute.endswith("range") or attribute in ("lower", "upper", "effort", "velocity")
                bad = words & ({"nan"} if bound else {"nan", "inf", "infinity"})
                if bad and attribute not in ("name", "class", "childclass"):
                    found.append(f"  {file.name}:{number}: {attribute}={value!r}")
    return found


def _place(path: Path, message: str, what: str) -> tuple[Path, int | None, str]:
    """File, line and tag that a message of MuJoCo is about."""
    element = re.search(r"Element '(.+?)', line", message)
    tag = element[1] if element else ""
    given = re.search(r", line ([1-9]\d*)", message)
    if given:
        return path, int(given[1]), tag
    # Of included files MuJoCo tells line 0: take the only line that fits.
    name = re.search(r"Element name '(.+?)'", message)
    attribute = re.search(r"attribute:? '(.+?)'", what)
    if name:
        sign = rf"name\s*=\s*[\"']{re.escape(name[1])}[\"']"
    elif tag:
        sign = rf"<{re.escape(tag)}\b" + (rf"[^>]*\b{re.escape(attribute[1])}\s*=" if attribute else "")
    else:
        return path, None, tag
    hits = [(file, number) for file in _files(path) for number, line in _lines(file) if re.search(sign, line)]
    return (*hits[0], tag) if len(hits) == 1 else (path, None, tag)


def _syntax(path: Path) -> str:
    for file in _files(path):
        raw = file.read_bytes()
        if not raw.lstrip().startswith(b"<"):
            start = raw.lstrip()[:30].decode("utf-8", "replace")
            return f"{file}: not XML: it starts with {start!r}; a model starts with <mujoco> or <robot>"
        try:
            expat.ParserCreate().Parse(raw, True)
        except expat.ExpatError as error:
            reason = expat.ErrorString(error.code)
            lines = [f"{file}:{error.lineno}: not well-formed XML: {reason} (column {error.offset})"]
            return "\n".join([*lines, *_source(file, error.lineno)])
    return f"{path}: not XML that MuJoCo can read; save it as UTF-8"


def _missing(path: Path, name: str) -> str:
    suffix = Path(name).suffix.lower()
    kind = "mesh" if suffix in _MESHES else "picture" if suffix in _PICTURES else "file"
    extensions = {"mesh": _MESHES, "picture": _PICTURES}.get(kind, (suffix,))
    place = next(
        ((file, n) for file in _files(path) for n, line in _lines(file) if Path(name).name in line),
        (path, None),
    )
    wanted = path.parent / name
    there = wanted.parent.iterdir() if wanted.parent.is_dir() else ()
    stems = {p.stem: p.name for p in there if p.suffix.lower() in extensions}
    close = [stems[stem] for stem in get_close_matches(wanted.stem, stems, n=1)]
    lines = [
        f"{place[0]}{f':{place[1]}' if place[1] else ''}: {kind} {Path(name).name!r} is missing"
        + (f" (did you mean {close[0]!r}?)" if close else ""),
        f"looked for {wanted}",
        f"{wanted.parent} holds {listing(wanted.parent, extensions)}",
    ]
    if not wanted.parent.is_dir() and wanted.parent != path.parent:
        lines.append(f"{path.parent} holds {listing(path.parent, extensions)}")
    return "\n".join(lines)


def _files(path: Path) -> list[Path]:
    """The file and those that it includes, at any depth."""
    files, queue = [], [path]
    while queue:
        file = queue.pop(0)
        if file in files or not file.is_file():
            continue
        files.append(file)
        # MuJoCo resolves every include against the folder of the main file.
        queue += [
            path.parent / name
            for _, line in _lines(file)
            for name in re.findall(r"<include\s+file=[\"'](.*?)[\"']", line)
        ]
    return files


def _lines(file: Path) -> list[tuple[int, str]]:
    """Numbered lines without comments."""
    text = file.read_text(encoding="utf-8", errors="replace")
    blank = re.sub(r"<!--.*?-->", lambda m: re.sub(r"[^\n]", " ", m[0]), text, flags=re.DOTALL)
    return list(enumerate(blank.split("\n"), start=1))


def _source(file: Path, line: int | None) -> list[str]:
    text = dict(_lines(file)).get(line, "").strip() if line else ""
    return ["    " + (text if len(text) <= 100 else text[:97] + "...")] if text else []


def _suggest(name: str, known: set[str], where: str) -> str:
    close = get_close_matches(name, sorted(known), n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"{hint}{where}: {', '.join(sorted(known))}"


def _parent(file: Path, line: int | None, tag: str) -> str:
    stack: list[str] = []
    found = [""]
    parser = expat.ParserCreate()

    def start(name: str, _: dict[str, str]) -> None:
        if name == tag and parser.CurrentLineNumber == line and not found[0]:
            found[0] = stack[-1] if stack else ""
        stack.append(name)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: stack.pop()
    try:
        parser.Parse(file.read_bytes(), True)
    except expat.ExpatError:
        return ""
    return found[0]


@cache
def _schema() -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Children and attributes of every MJCF element, from MuJoCo's own table (indents of 3)."""
    children: dict[str, set[str]] = {}
    attributes: dict[str, set[str]] = {}
    stack: list[str] = []
    for row in mujoco.mj_printSchema(False, False).replace("(world)body", "body").splitlines():
        head = re.match(r"( *)(\w+) \(.\)(.*)", row)
        if head:
            depth = len(head[1]) // 3
            stack = [*stack[:depth], head[2]]
            if depth:
                children.setdefault(stack[-2], set()).add(head[2])
            attributes.setdefault(head[2], set()).update(head[3].split())
        elif stack:
            attributes[stack[-1]].update(row.split())
    # The table writes these once, as one recursive element.
    children["body"] |= {"body", "frame", "replicate"}
    children["mujoco"] = children["mujoco"] - {"body"} | {"worldbody"}
    children["default"].add("default")
    for alias in ("worldbody", "frame", "replicate"):
        children[alias] = children["body"]
    attributes["worldbody"] = set()
    return children, attributes
