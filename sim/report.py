"""Work against precision: which engine and method reach which error at what cost, and what to take."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from .dynamics.smooth import Smooth
from .errors import EngineError
from .hard_cases import HARD_CASES, HardCase
from .work_precision import (
    Case,
    Motion,
    Row,
    mujoco_reference,
    runners,
    smooth_or_none,
    smooth_reference,
    sweep,
    trajectory_error,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .plan import Plan
    from .scene.schema import Scene

ENGINES = ("smooth", "mujoco", "scipy")
TARGETS = (1e-3, 1e-6, 1e-9)
"""Errors [rad, m] that the recommendation is about."""


@dataclass(frozen=True, eq=False)
class Report:
    """Work against precision of one case.

    Attributes:
        name: of the case.
        rows: the table; `Row.error` in rad and m for a motion, in units of the case's scale for a hard case.
        reference: what errors are measured against, in words.
        uncertainty: error of that reference itself; errors below it say nothing.
        notes: what was left out, and why.
    """

    name: str
    rows: tuple[Row, ...]
    reference: str
    uncertainty: float
    notes: tuple[str, ...] = ()

    def cheapest(self, target: float, *, engine: str | None = None) -> Row | None:
        """The row of least processor time whose error is at most `target`; None when there is none."""
        good = [
            row
            for row in self.rows
            if row.error <= target and engine in (None, row.engine) and self.uncertainty <= target
        ]
        return min(good, key=lambda row: row.cpu_s, default=None)

    def recommendation(self) -> str:
        """What to take for each of TARGETS, and what that saves against MuJoCo's best setting."""
        sentences = []
        for target in TARGETS:
            best = self.cheapest(target)
            if best is None:
                why = "the reference is not that sure" if self.uncertainty > target else "nothing reaches it"
                sentences.append(f"Error {target:.0e}: {why}.")
                continue
            text = f"Error {target:.0e}: {_setting(best)} in {_seconds(best.cpu_s)} of processor time"
            rival = self.cheapest(target, engine="mujoco")
            if best.engine != "mujoco" and rival is not None:
                text += f", {rival.cpu_s / best.cpu_s:.3g} times less than {_setting(rival)}"
            elif best.engine != "mujoco" and any(row.engine == "mujoco" for row in self.rows):
                text += "; MuJoCo's integrators do not reach it at the steps tried"
            sentences.append(text + ".")
        return "\n".join([*sentences, *_stiffness(self.rows)])

    def table(self) -> list[dict[str, Any]]:
        """The rows as dictionaries."""
        return [asdict(row) for row in self.rows]

    def figure(self) -> Figure:
        """Error against processor time and against evaluations, a line for each method."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(11, 5), layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        colors = {"smooth": "tab:blue", "mujoco": "tab:red", "scipy": "tab:green", "torch": "tab:purple"}
        markers = "osv^<>DPX*dph"
        for n, (key, rows) in enumerate(_by_method(self.rows).items()):
            seen = [row for row in rows if row.error > 0]
            style = {
                "color": colors.get(key[0], "black"),
                "marker": markers[n % len(markers)],
                "markersize": 4,
                "linestyle": "-" if key[2] == "tolerance" else ":",
                "linewidth": 1,
            }
            label = f"{key[0]} {key[1]}" + (" (adaptive)" if key[2] == "tolerance" else "")
            axes[0].loglog(
                [1e3 * row.cpu_s for row in seen], [row.error for row in seen], label=label, **style
            )
            axes[1].loglog([row.evaluations for row in seen], [row.error for row in seen], **style)
        for ax, what in zip(
            axes, ("processor time [ms]", "evaluations of the equations of motion"), strict=True
        ):
            ax.axhspan(1e-17, max(self.uncertainty, 1e-17), color="0.9")
            ax.set_xlabel(what)
            ax.grid(alpha=0.3)
        errors = [row.error for row in self.rows if row.error > 0]
        axes[0].set_ylim(min([*errors, 1e-3]) / 3, min(max([*errors, 1e-3]) * 3, 1e2))
        axes[0].set_ylabel("global error [rad, m]; grey: the reference's own")
        figure.suptitle(self.name)
        figure.legend(loc="outside right upper", fontsize=7)
        return figure

    def write(self, folder: str | Path) -> Path:
        """Write table.csv, report.json, report.txt and report.png into `folder`, made when missing."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "table.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, [field.name for field in fields(Row)])
            writer.writeheader()
            writer.writerows(self.table())
        finite = [{k: _json(v) for k, v in row.items()} for row in self.table()]
        content = {
            "name": self.name,
            "reference": self.reference,
            "uncertainty": _json(self.uncertainty),
            "notes": list(self.notes),
            "recommendation": self.recommendation().splitlines(),
            "rows": finite,
        }
        (folder / "report.json").write_text(json.dumps(content, indent=1) + "\n")
        (folder / "report.txt").write_text(str(self))
        self.figure().savefig(folder / "report.png", dpi=120)
        return folder

    def __str__(self) -> str:
        lines = [self.name, f"Reference: {self.reference}; its own error about {self.uncertainty:.1e}."]
        lines += [f"Note: {note}." for note in self.notes]
        lines += ["", f"{'engine':8}{'method':14}{'setting':>20}{'error':>10}{'cpu':>10}{'evaluations':>13}"]
        for row in self.rows:
            knob = f"{row.knob} {row.setting:.3g}" + (" s" if row.knob == "step" else "")
            error = f"{row.error:.1e}" if math.isfinite(row.error) else "diverged"
            lines.append(
                f"{row.engine:8}{row.method:14}{knob:>20}{error:>10}{_seconds(row.cpu_s):>10}{row.evaluations:>13}"
            )
        return "\n".join([*lines, "", self.recommendation(), ""])


def report(
    subject: Case | HardCase | Scene | Plan | mujoco.MjModel | str | Path,
    out_dir: str | Path | None = None,
    *,
    engines: Sequence[str] = ENGINES,
    budget_s: float = 0.5,
    progress: Callable[[str], None] | None = None,
) -> Report:
    """Compare engines and methods on one motion.

    Args:
        subject: a case, a hard case, a scene or its plan or file; a bare model swings from its first
            configuration for two seconds.
        out_dir: folder for table.csv, report.json, report.txt and report.png; nothing is written when None.
        engines: of "smooth", "mujoco", "scipy" and "torch" (extra `torch`).
        budget_s: a method is refined until a run costs that much processor time [s].
        progress: told the method at work.

    Raises:
        EngineError: a scene that the report cannot judge yet, or a reference that did not reach its end.
    """
    hard = subject if isinstance(subject, HardCase) else None
    case, notes = (hard.case(), ()) if hard is not None else case_of(subject)
    smooth, why = smooth_or_none(case.model)
    if smooth is None:
        notes = (*notes, f"no smooth engine: {why}")
    elif smooth.differences:
        notes = (*notes, *(f"smooth engine: {difference}" for difference in smooth.differences))
    error, source, uncertainty = _measure(case, hard, smooth)
    rows: list[Row] = []
    for runner in runners(case, smooth, engines):
        if progress is not None:
            progress(f"{runner.engine} {runner.method} by {runner.knob}")
        rows += sweep(runner, error, floor=uncertainty, budget_s=budget_s)
    result = Report(case.name, tuple(rows), source, uncertainty, notes)
    if out_dir is not None:
        result.write(out_dir)
    return result


def hard_suite(
    out_dir: str | Path | None = None,
    *,
    engines: Sequence[str] = ENGINES,
    budget_s: float = 0.5,
    progress: Callable[[str], None] | None = None,
) -> tuple[Report, ...]:
    """`report` for each of HARD_CASES against its known end, one folder a case in `out_dir`."""
    reports = []
    for hard in HARD_CASES:
        folder = None if out_dir is None else Path(out_dir) / hard.name.replace(" ", "_").replace("'", "")

        def told(what: str, name: str = hard.name) -> None:
            if progress is not None:
                progress(f"{name}: {what}")

        reports.append(report(hard, folder, engines=engines, budget_s=budget_s, progress=told))
    return tuple(reports)


def case_of(subject: Case | Scene | Plan | mujoco.MjModel | str | Path) -> tuple[Case, tuple[str, ...]]:
    """The motion to compare, and notes on what it leaves out.

    Raises:
        EngineError: the scene has keyed joints, a controller, servos or pushes, which reports do not do yet.
    """
    if isinstance(subject, Case):
        return subject, ()
    if isinstance(subject, mujoco.MjModel):
        data = mujoco.MjData(subject)
        return Case("model", subject, data.qpos.copy(), data.qvel.copy(), 2.0), ()
    from .engines.interface import Role
    from .plan import Plan, make_plan
    from .scene.load import load_scene

    if isinstance(subject, str | Path):
        subject = load_scene(subject)
    plan = subject if isinstance(subject, Plan) else make_plan(subject)
    problem = plan.problem
    found = {
        "a controller": plan.period is not None,
        "keyed joints": bool(np.any(problem.roles == Role.KEYED)),
        "servos that follow keys": bool(problem.servo),
        "pushes": bool(problem.wrenches),
    }
    beyond = [words for words, present in found.items() if present]
    if beyond:
        raise EngineError(
            f"a report compares free motion so far; this scene has {', '.join(beyond)}: "
            "give their joints the passive role, or report on a copy without them"
        )
    state = problem.state0
    name = str(plan.setup.scene.model_dump().get("name") or "scene")
    return Case(name, problem.model, state.q, state.v, problem.duration), ()


def _measure(
    case: Case, hard: HardCase | None, smooth: Smooth | None
) -> tuple[Callable[[Motion], float], str, float]:
    """How a motion's error is found, against what, and how sure that is."""
    if hard is not None:
        return (lambda motion: hard.error(motion, case.model)), hard.source, 1e-15
    if smooth is not None:
        reference = smooth_reference(case, smooth)
    else:
        reference = mujoco_reference(case, case.duration / case.frames / 2**10)
    return (
        (lambda motion: trajectory_error(case, motion, reference.motion)),
        reference.source,
        reference.uncertainty,
    )


def _by_method(rows: Sequence[Row]) -> dict[tuple[str, str, str], list[Row]]:
    found: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.engine, row.method, row.knob), []).append(row)
    return found


def _stiffness(rows: Sequence[Row]) -> list[str]:
    """A sentence when a loose tolerance costs an explicit method as much as a tight one."""
    by_method = _by_method(rows)
    loose = [
        row for row in by_method.get(("smooth", "dopri5", "tolerance"), []) if row.setting in (1e-3, 1e-6)
    ]
    if len(loose) == 2 and loose[1].evaluations < 1.3 * loose[0].evaluations:
        return ["Stiff: DOPRI5 takes as many steps at 1e-3 as at 1e-6, its stability sets them."]
    return []


def _setting(row: Row) -> str:
    if row.knob == "step":
        return f"{row.engine} {row.method} at a step of {_seconds(row.setting)}"
    return f"{row.engine} {row.method} at a tolerance of {row.setting:.0e}"


def _seconds(t: float) -> str:
    """A time with the unit that suits it."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if t >= size:
            return f"{t / size:.3g} {unit}"
    return f"{t / 1e-9:.3g} ns"


def _json(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
