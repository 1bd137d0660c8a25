"""The command `pantograph ik`: a pose from a goal, with its verdict."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..errors import PantographError

if TYPE_CHECKING:
    from ..ik import Goal, Solution

console = Console()


def ik(
    model: Annotated[str, typer.Argument(help="Built-in model or model file; see 'pantograph models'.")],
    to: Annotated[str, typer.Option(help="Target: x,y,z [m], or x,y,z,qw,qx,qy,qz.")],
    site: Annotated[str | None, typer.Option(help="Site to bring there; body:NAME for a body.")] = None,
    joint: Annotated[
        list[str] | None, typer.Option(help="Joint that may move, or a pattern as 'left_*'; default all.")
    ] = None,
    hold: Annotated[
        list[str] | None, typer.Option(help="Site or body:NAME that keeps its pose, as a foot on the ground.")
    ] = None,
    keyframe: Annotated[str | None, typer.Option(help="Keyframe of the model to start from.")] = None,
    prefer: Annotated[
        str | None,
        typer.Option(help="Among poses: near (default), middle, manipulability, or clear of --obstacle."),
    ] = None,
    obstacle: Annotated[
        list[str] | None,
        typer.Option(
            help="Geoms GEOM,GEOM to keep apart as far as the goals allow; exit status 1 if they overlap."
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="List all distinct solutions.")] = False,
    film: Annotated[
        Path | None, typer.Option(help="Film the way there: .mp4, .gif, or a picture .png.")
    ] = None,
    restarts: Annotated[int, typer.Option(help="Random starts before giving up.", min=0)] = 200,
    seed: Annotated[int, typer.Option(help="Of the random starts.")] = 0,
) -> None:
    """Bring a site to a place: prints the pose and whether, or why not, it can be met."""
    from ...models import load_model
    from ..ik import solve

    loaded = load_model(model)
    start = _start(loaded, keyframe)
    goals = [_goal(loaded, site, to), *(_held(loaded, name, start) for name in hold or [])]
    pairs = _pairs(loaded, obstacle)
    solution = solve(
        loaded, goals, q0=start, joints=_joints(loaded, joint),
        prefer=_preference(prefer, obstacle), obstacles=pairs,  # type: ignore[arg-type]
        restarts=restarts, seed=seed, all=every,
    )  # fmt: skip
    overlaps = _overlaps(loaded, pairs, solution.q)
    _show(loaded, solution, start, overlaps)
    if film is not None:
        console.print(f"film: {_film(loaded, goals[1:], start, solution.q, film)}")
    if overlaps or not solution.solved:
        raise typer.Exit(1)


def _start(model: Any, keyframe: str | None) -> Any:
    if keyframe is None:
        return model.qpos0
    names = [model.key(k).name for k in range(model.nkey)]
    if keyframe not in names:
        raise PantographError(
            f"no keyframe {keyframe!r}; the model has: {', '.join(filter(None, names)) or 'none'}"
        )
    return model.key_qpos[names.index(keyframe)]


def _joints(model: Any, patterns: list[str] | None) -> list[str] | None:
    """Names of the joints that names or patterns mean."""
    from ..scene.names import Names

    if patterns is None:
        return None
    names, out = Names(model, "joint"), []
    by_id = {i: name for name, i in names.ids.items()}
    for pattern in patterns:
        found = names.match(pattern)
        if not found:
            raise PantographError(names.missing(pattern))
        out += [by_id[i] for i in found]
    return out


def _preference(prefer: str | None, obstacles: list[str] | None) -> str:
    """What decides between poses: who names obstacles wants to be clear of them."""
    if obstacles and prefer not in (None, "clear"):
        raise PantographError(f"--obstacle belongs to --prefer clear, not to --prefer {prefer}")
    if prefer == "clear" and not obstacles:
        raise PantographError("--prefer clear needs the pairs of geoms to keep apart: --obstacle GEOM,GEOM")
    return prefer or ("clear" if obstacles else "near")


def _pairs(model: Any, obstacles: list[str] | None) -> list[tuple[str, str]]:
    """Pairs of geoms from the words of the command line."""
    from ...models import names_of
    from ..errors import unknown

    out, geoms = [], names_of(model, "geom")
    for text in obstacles or []:
        pair = text.split(",")
        if len(pair) != 2:
            raise PantographError(f"--obstacle is a pair of geoms, GEOM,GEOM, not {text!r}")
        for name in pair:
            if name not in geoms:
                raise PantographError(unknown("geom", name, geoms))
        out.append((pair[0], pair[1]))
    return out


def _overlaps(model: Any, pairs: list[tuple[str, str]], q: Any) -> list[str]:
    """Pairs that overlap at q (nq,), in words."""
    from ..ik.collision import Clearance

    if not pairs:
        return []
    gaps = zip(pairs, Clearance(model, pairs).gaps(q), strict=True)
    return [f"{a} and {b} overlap by {-gap.distance:.3g} m" for (a, b), gap in gaps if gap.distance < 0]


def _held(model: Any, name: str, start: Any) -> Goal:
    """The goal that a frame stays as it is at the start (nq,)."""
    from ..ik import Pose
    from ..ik.pose import parse_frame
    from ..kinematics import frame
    from ..rotations import from_matrix

    X = frame(model, *parse_frame(name)).pose(start)
    return Pose(name, X[:3, 3], from_matrix(X[:3, :3]), name=f"hold {name}")


def _goal(model: Any, site: str | None, to: str) -> Goal:
    """The goal of the words of the command line."""
    from ...models import names_of
    from ..ik import Pose, Position

    sites = names_of(model, "site")
    if site is None:
        if len(sites) != 1:
            raise PantographError(
                f"name the site to move with --site; the model has: {', '.join(sites)}"
                if sites
                else "this model has no sites; name a body to move, as --site "
                f"body:{names_of(model, 'body')[-1]}; it has: {', '.join(names_of(model, 'body')[1:])}"
            )
        site = sites[0]
    try:
        numbers = [float(x) for x in to.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 7):
        raise PantographError(f"--to is x,y,z or x,y,z,qw,qx,qy,qz, not {to!r}")
    return Position(site, numbers) if len(numbers) == 3 else Pose(site, numbers[:3], numbers[3:])


def _show(model: Any, solution: Solution, start: Any, overlaps: list[str]) -> None:
    color = ("yellow" if overlaps else "green") if solution.solved else "red"
    console.print(f"[bold {color}]{escape(str(solution.verdict))}[/]", highlight=False, soft_wrap=True)
    for words in overlaps:
        console.print(f"[bold red]not clear: {escape(words)}[/]", highlight=False, soft_wrap=True)
    answers = solution.solutions if len(solution.solutions) > 1 else [solution.q]
    table = Table()
    table.add_column("joint")
    for k in range(len(answers)):
        table.add_column("value" if len(answers) == 1 else str(k + 1), justify="right")
    table.add_column("range", justify="right")
    for name, cells, limits in _rows(model, answers, start):
        table.add_row(escape(name), *cells, limits)
    console.print(table)
    for r in solution.residuals:
        console.print(
            f"{escape(r.goal)}: {r.position:.3g} m, {r.rotation:.3g} rad {'met' if r.met else 'not met'}"
        )
    console.print(f"{solution.seconds * 1e3:.0f} ms, {solution.restarts} restarts")


def _rows(model: Any, answers: Any, start: Any) -> list[tuple[str, list[str], str]]:
    """Joints that moved: name, a cell for every answer, range."""
    from ...models import name_of
    from ..kinds import BALL, FREE, HINGE

    out = []
    for j in range(model.njnt):
        at, kind = int(model.jnt_qposadr[j]), int(model.jnt_type[j])
        part = slice(at, at + {FREE: 7, BALL: 4}.get(kind, 1))
        if all(abs(q[part] - start[part]).max() < 1e-12 for q in answers):
            continue
        unit = "rad" if kind == HINGE else "m" if kind not in (FREE, BALL) else ""
        cells = [" ".join(f"{x:.6g}" for x in q[part]) + f" {unit}" for q in answers]
        low, high = model.jnt_range[j]
        out.append(
            (name_of(model, "joint", j), cells, f"{low:.4g} to {high:.4g}" if model.jnt_limited[j] else "")
        )
    return out


def _film(model: Any, held: list[Goal], start: Any, q: Any, path: Path) -> Path:
    """The way from the start to the answer in two seconds, or a picture of the answer."""
    import numpy as np

    from ..film import film, still
    from ..ik import Posture, blend, follow

    if path.suffix.lower() == ".png":
        return still(model, q, path)
    t = np.linspace(0.0, 2.0, 61)
    x = np.clip((t - 0.3) / 1.2, 0.0, 1.0)
    share = x * x * (3 - 2 * x)
    way = blend(model, np.tile(start, (len(t), 1)), np.tile(q, (len(t), 1)), share)
    if held:
        way = follow(model, [[*held, Posture(near, weight=1.0)] for near in way], t, start=way[0]).q
    return film(model, t, way, path)
