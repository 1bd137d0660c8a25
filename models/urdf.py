"""URDF into MuJoCo's description.

Decisions, each of which the file's own `<mujoco><compiler .../></mujoco>` may overrule:
- the root link stands fixed in the world; other links keep their names (`fusestatic` off), except that a
  floating joint can only hang on the world, so that files with one are fused;
- visual geoms are kept (`discardvisual` off), weigh nothing, and replace their link's collision geoms in
  pictures;
- inertias that no body can have are balanced (`balanceinertia` on), with a warning that names the links.
`package://` and relative mesh paths are looked for beside the file and in the folders above it.
"""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np

from .diagnose import listing
from .errors import ModelError, unknown

_JOINTS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
_MESHES = (".stl", ".obj", ".msh")
_COLLISION_GROUP = 3  # MuJoCo's own pictures leave it out by default


def is_urdf(text: str) -> bool:
    """Whether the root element is `<robot>`."""
    root = re.search(
        r"<\s*([A-Za-z][\w:.-]*)", re.sub(r"<!--.*?-->|<\?.*?\?>|<![A-Z].*?>", "", text, flags=re.DOTALL)
    )
    return root is not None and root[1] == "robot"


def parse(path: Path, text: str, notes: list[str]) -> mujoco.MjSpec:
    """Spec of a URDF file; what had to be changed or left out is appended to `notes`.

    Raises:
        ModelError: broken XML or structure, or a mesh that is not there; lists all mistakes at once.
        ValueError: MuJoCo refuses the rest.
    """
    if "<xacro:" in text:
        raise ModelError(f"{path}: contains xacro macros; expand it first: xacro IN > {path.stem}.urdf")
    try:
        robot = ET.fromstring(text)
    except ET.ParseError as error:
        raise ModelError(f"{path}:{error.position[0]}: not well-formed XML: {error}") from error
    mistakes = _structure(robot) + _resolve_meshes(path, robot, notes)
    if mistakes:
        raise ModelError(
            "\n".join([f"{path}: {len(mistakes)} mistake(s) in this URDF", *("  " + m for m in mistakes)])
        )
    _settings(robot, notes)
    notes += _guessed_masses(robot)
    try:
        spec = mujoco.MjSpec.from_string(ET.tostring(robot, encoding="unicode"))
    except ValueError as error:
        raise ValueError(re.sub(r"line \d+", "line 0", str(error))) from error  # lines of the rewritten text
    _draw_visuals(spec)
    return spec


def _structure(robot: ET.Element) -> list[str]:
    mistakes = []
    links = [link.get("name", "") for link in robot.findall("link")]
    joints = [joint.get("name", "") for joint in robot.findall("joint")]
    for kind, names in (("link", links), ("joint", joints)):
        mistakes += [
            f"{kind} {name!r} occurs {names.count(name)} times"
            for name in sorted(set(names))
            if names.count(name) > 1
        ]
    if not links:
        mistakes.append("there is no <link>")
    for joint in robot.findall("joint"):
        name = joint.get("name", "")
        if joint.get("type") not in _JOINTS:
            mistakes.append(f"joint {name!r}: type {joint.get('type')!r}; URDF has: {', '.join(_JOINTS)}")
        for end in ("parent", "child"):
            element = joint.find(end)
            link = None if element is None else element.get("link")
            if link is None:
                mistakes.append(f"joint {name!r}: <{end} link=...> is missing")
            elif link not in links:
                mistakes.append(f"joint {name!r}: " + unknown(f"{end} link", link, links, where="this file"))
    return mistakes


def _resolve_meshes(path: Path, robot: ET.Element, notes: list[str]) -> list[str]:
    """Make every mesh path absolute; drop visuals in formats that MuJoCo cannot read."""
    mistakes = []
    compiler = robot.find("mujoco/compiler")
    folder = path.parent / (compiler.get("meshdir", "") if compiler is not None else "")
    for link in robot.findall("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            mesh = part.find("geometry/mesh")
            if mesh is None:
                continue
            asked = mesh.get("filename", "")
            tried = _candidates(path, folder, asked)
            file = next((c for c in tried if c.is_file()), None)
            where = f"link {link.get('name')!r}: {part.tag} mesh {asked!r}"
            if file is None:
                near = ", ".join(str(c) for c in tried[:4])
                mistakes.append(
                    f"{where} is missing; looked for {near}; {path.parent} holds {_meshes_below(path.parent)}"
                )
            elif file.suffix.lower() in _MESHES:
                mesh.set("filename", str(file.resolve()))
            elif part.tag == "visual":
                notes.append(f"{where} is left out: MuJoCo reads {', '.join(_MESHES)}; convert it to see it")
                link.remove(part)
            else:
                mistakes.append(f"{where}: MuJoCo reads {', '.join(_MESHES)}; convert it")
    return mistakes


def _candidates(path: Path, folder: Path, asked: str) -> list[Path]:
    """Where a mesh may lie: as written, in a package folder above the file, or beside it by name."""
    written = re.sub(r"^(file|package|model)://", "", asked)
    if not re.match(r"^(package|model)://", asked):
        first = [Path(written)] if Path(written).is_absolute() else [path.parent / written, folder / written]
    else:
        inside = written.partition("/")[2]
        above = [path.parent, *path.parent.parents]
        first = [root / tail for root in above[:5] for tail in (written, inside)]
    name = Path(written).name
    return list(dict.fromkeys([*first, folder / name, path.parent / "meshes" / name]))


def _meshes_below(folder: Path) -> str:
    found = sorted(str(p.relative_to(folder)) for p in folder.glob("**/*") if p.suffix.lower() in _MESHES)[
        :12
    ]
    return ", ".join(found) or listing(folder, _MESHES)


def _settings(robot: ET.Element, notes: list[str]) -> None:
    section = robot.find("mujoco")
    if section is None:
        section = ET.Element("mujoco")
        robot.insert(0, section)
    compiler = section.find("compiler")
    if compiler is None:
        compiler = ET.SubElement(section, "compiler")
    floating = any(joint.get("type") == "floating" for joint in robot.findall("joint"))
    wanted = {
        "fusestatic": "true" if floating else "false",
        "discardvisual": "false",
        "balanceinertia": "true",
    }
    if compiler.get("balanceinertia") is None:
        unreal = [link.get("name", "") for link in robot.findall("link") if _unreal(link)]
        if unreal:
            notes.append(
                "no body can have the inertia (A + B < C) of link "
                + ", ".join(unreal)
                + "; replaced by the mean of its moments; correct it in the file"
            )
    for name, value in wanted.items():
        compiler.attrib.setdefault(name, value)
    compiler.set("strippath", "false")  # the paths are absolute by now


def _unreal(link: ET.Element) -> bool:
    inertia = link.find("inertial/inertia")
    if inertia is None:
        return False
    xx, yy, zz, xy, xz, yz = (
        float(inertia.get(name, "0")) for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if not np.isfinite(matrix).all():
        return False
    small, middle, large = np.linalg.eigvalsh(matrix)
    return bool(small + middle < large * (1 - 1e-6))


def _guessed_masses(robot: ET.Element) -> list[str]:
    """Without <inertial> a link of URDF has no mass; MuJoCo gives it that of its collision geoms."""
    moved = {j.find("child").get("link") for j in robot.findall("joint") if j.get("type") != "fixed"}  # type: ignore[union-attr]
    bare = [
        link.get("name", "")
        for link in robot.findall("link")
        if link.get("name") in moved and link.find("inertial") is None and link.find("collision") is not None
    ]
    if not bare:
        return []
    return [f"no <inertial> in link {', '.join(bare)}; mass taken from its collision geoms at 1000 kg/m^3"]


def _draw_visuals(spec: mujoco.MjSpec) -> None:
    for body in spec.bodies:
        solid = [geom for geom in body.geoms if geom.contype or geom.conaffinity]
        if len(solid) < len(body.geoms):
            for geom in solid:
                geom.group = _COLLISION_GROUP
