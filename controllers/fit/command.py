"""The command `pantograph fit`, which makes keyed motion possible."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from ...sim.errors import PantographError

console = Console()
SceneFile = Annotated[Path, typer.Argument(help="Scene file (TOML) with keyed joints.")]


def fit(
    scene: SceneFile,
    how: Annotated[str, typer.Option(help="check, retime (fastest), nearest (timing), or fit.")] = "check",
    velocity: Annotated[list[str] | None, typer.Option(help="Limit [rad/s, m/s]: 3, or elbow=2.")] = None,
    acceleration: Annotated[list[str] | None, typer.Option(help="Limit [rad/s^2, m/s^2].")] = None,
    jerk: Annotated[list[str] | None, typer.Option(help="Limit [rad/s^3, m/s^3].")] = None,
    force: Annotated[list[str] | None, typer.Option(help="Limit [N m, N]; default: the model's.")] = None,
    top_speed: Annotated[
        list[str] | None, typer.Option(help="Speed where a motor gives nothing more.")
    ] = None,
    passive: Annotated[list[str] | None, typer.Option(help="Joint without a drive (fit only).")] = None,
    hard: Annotated[
        list[float] | None, typer.Option(help="Time of a key to pass through (fit only).")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the recording of the new motion.")] = Path("out"),
) -> None:
    """Check the keyed motion of a scene against a machine, or make it possible."""
    from ...sim.plan import make_plan
    from ...sim.scene.load import load_scene
    from .. import fit as fitting

    ways = ("check", "retime", "nearest", "fit")
    if how not in ways:
        raise PantographError(f"no way {how!r} to fit; there is: {', '.join(ways)}")
    plan = make_plan(load_scene(scene))
    problem = plan.problem
    driven = _driven(problem.model, passive or [])
    given = {
        "velocity": velocity,
        "acceleration": acceleration,
        "jerk": jerk,
        "force": force,
        "top_speed": top_speed,
    }
    limits: dict[str, Any] = {k: _limit(v) for k, v in given.items()}
    able = fitting.machine(problem.model, driven=driven, **limits)
    report = fitting.check(problem.clip, able)
    console.print("as keyed: " + ("possible" if report.possible else "impossible"))
    for violation in report.violations:
        console.print(f"  {violation}", soft_wrap=True)
    if how == "check":
        raise typer.Exit(0 if report.possible else 1)
    if how == "fit":
        fitted = fitting.fit(problem.clip, able, hard=hard or [])
        clip = fitted.clip
        console.print(
            f"fitted, up to {fitted.deviation:.4g} rad or m from the keys: {fitted.certificate}",
            soft_wrap=True,
        )
        proof = fitting.prove(fitted, able)
        console.print(
            f"simulated with LQR in the loop: within {proof.worst:.3g} rad or m of the fitted motion"
        )
    else:
        retimed = fitting.retime(problem.clip, able, keep=how == "nearest")
        clip = retimed.clip
        was = problem.clip.end - problem.clip.start
        console.print(
            f"retimed: {retimed.duration:.4f} s, was {was:.4f} s; limits in use {retimed.report.worst:.4%}"
        )
    console.print(f"recording: {_record(plan, clip, out / f'{scene.stem}.fit.npz')}")


def _record(plan: Any, clip: Any, path: Path) -> Path:
    """The motion of a clip as a recording, every joint keyed."""
    from dataclasses import replace

    import numpy as np

    from ...sim.engines.interface import Role
    from ...sim.plan import Choice
    from ...sim.run import run

    roles = np.full_like(plan.problem.roles, Role.KEYED)
    h = 1.0 / 240.0
    steps = max(1, math.ceil((clip.end - clip.start) / h))
    problem = replace(plan.problem, clip=clip, roles=roles, duration=steps * h, step=h, sample_every=1)
    kinematic = Choice("kinematic", "the motion is known")
    setup = replace(plan.setup, roles=roles, clip=clip)
    recording = run(replace(plan, setup=setup, problem=problem, engine=kinematic, period=None))
    return recording.save(path)


def _driven(model: Any, passive: list[str]) -> Any:
    """Mask (nv,) of the freedoms with a drive."""
    import numpy as np

    from ...models import lookup

    driven = np.ones(model.nv, dtype=bool)
    for name in passive:
        driven[model.dof_jntid == lookup(model, "joint", name)] = False
    return driven


def _limit(texts: list[str] | None) -> float | dict[str, float] | None:
    """One number for all joints, or one a joint from texts such as elbow=2."""
    if not texts:
        return None
    named = {}
    for text in texts:
        name, sign, value = text.rpartition("=")
        try:
            number = float(value)
        except ValueError:
            raise PantographError(f"a limit is a number, or JOINT=number, not {text!r}") from None
        if not sign:
            return number
        named[name] = number
    return named
