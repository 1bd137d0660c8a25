"""Work against precision: which engine and method reach which error at what cost, and what to take."""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco

from .hard_cases import HARD_CASES, HardCase
from .recording import check_writable
from .report_work import Apart, Error, Work, physics
from .scene_work import is_free, scene_case, scene_references, scene_runners
from .work_precision import (
    SURE,
    Case,
    Reference,
    Row,
    Runner,
    by_method,
    trajectory_error,
)
from .work_runners import (
    FOREIGN,
    check_engines,
    mujoco_reference,
    runners,
    smooth_or_none,
    smooth_reference,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .plan import Plan
    from .scene.schema import Scene

ENGINES = ("smooth", "mujoco", "scipy")
TARGETS = (1e-3, 1e-6, 1e-9)
"""Errors [rad, m] that the recommendation is about."""


_KEYED = "every joint is keyed: poses are those of the keys, to rounding, and nothing is integrated"
RIVALS = ("mujoco", "contact")
"""Engines whose best setting a recommendation is compared with."""


@dataclass(frozen=True)
class Yardstick:
    """What errors are measured against.

    Attributes:
        source: in words.
        uncertainty: error of the reference itself; errors below it say nothing.
        engine: whose rows; "" for all.
        sure_until: when the reference's own error first exceeds 1e-3 rad or m [s]; infinite when never.
    """

    source: str
    uncertainty: float
    engine: str = ""
    sure_until: float = math.inf


@dataclass(frozen=True, eq=False)
class Report:
    """Work against precision of one case.

    Attributes:
        name: of the case.
        rows: the table.
        yardsticks: what errors are measured against.
        notes: what was left out, and why.
        measure: what `Row.error` and `Row.estimate` are, in words.
        status: "done", or "interrupted" where rows are missing because somebody did not wait.
    """

    name: str
    rows: tuple[Row, ...]
    yardsticks: tuple[Yardstick, ...]
    notes: tuple[str, ...] = ()
    measure: str = "global error [rad, m]"
    status: str = "done"

    def uncertainty(self, engine: str) -> float:
        """Error of the reference that an engine's rows are measured against."""
        engine = physics(engine)
        return next((y.uncertainty for y in self.yardsticks if y.engine in ("", engine)), math.nan)

    def cheapest(self, target: float, *, engines: Sequence[str] = ()) -> Row | None:
        """The row of least processor time with an error of at most `target`, of some engines or of all."""
        good = [
            row
            for row in self.rows
            if row.error <= target
            and (not engines or row.engine in engines)
            and self.uncertainty(row.engine) <= target
        ]
        return min(good, key=lambda row: row.cpu_s, default=None)

    def recommendation(self) -> str:
        """What to take for each of TARGETS, and what that saves against MuJoCo's best setting."""
        if not self.rows:
            return "Nothing to choose: no method is at work."
        sentences = []
        for target in TARGETS:
            best = self.cheapest(target)
            if best is None:
                unsure = all(y.uncertainty > target for y in self.yardsticks)
                why = "the reference is not that sure" if unsure else "nothing reaches it"
                sentences.append(f"Error {target:.0e}: {why}.")
                continue
            text = f"Error {target:.0e}: {_setting(best)} in {_seconds(best.cpu_s)} of processor time"
            rival = self.cheapest(target, engines=RIVALS)
            if best.engine not in RIVALS and rival is not None:
                text += f", {rival.cpu_s / best.cpu_s:.3g} times less than {_setting(rival)}"
            elif best.engine not in RIVALS and any(row.engine in RIVALS for row in self.rows):
                text += "; MuJoCo's integrators do not reach it at the steps tried"
            sentences.append(text + ".")
        return "\n".join([*sentences, *_stiffness(self.rows), *self._unsure()])

    def _unsure(self) -> list[str]:
        """Where references stop to say where a motion goes, a sentence each."""
        sentences = []
        for y in self.yardsticks:
            if math.isfinite(y.sure_until):
                whose = f" of the {y.engine} engine" if y.engine else ""
                sentences.append(
                    f"Beyond {y.sure_until:.3g} s the reference{whose} is not sure to {SURE:g}: errors grow "
                    "fast there (chaos, impacts), or its steps are too long. Ask for less time, or for "
                    "statistics over many starts."
                )
        return sentences

    def table(self) -> list[dict[str, Any]]:
        """The rows as dictionaries."""
        return [asdict(row) for row in self.rows]

    def figure(self) -> Figure:
        """Error against processor time and against evaluations, a line for each method."""
        from .report_figure import draw

        unsure = [(y.engine, y.uncertainty) for y in self.yardsticks]
        return draw(self.name, self.measure, by_method(self.rows), unsure)

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
            "measure": self.measure,
            "status": self.status,
            "references": [{k: _json(v) for k, v in asdict(y).items()} for y in self.yardsticks],
            "notes": list(self.notes),
            "recommendation": self.recommendation().splitlines(),
            "rows": finite,
        }
        (folder / "report.json").write_text(json.dumps(content, indent=1) + "\n")
        (folder / "report.txt").write_text(str(self))
        self.figure().savefig(folder / "report.png", dpi=120)
        return folder

    def __str__(self) -> str:
        return self._text(self.rows)

    def brief(self) -> str:
        """As `str`, with only the rows that no other beats in both error and processor time."""
        best: list[Row] = []
        for row in sorted(self.rows, key=lambda row: (row.cpu_s, row.error)):
            if math.isfinite(row.error) and (not best or row.error < best[-1].error):
                best.append(row)
        return self._text(best)

    def _text(self, rows: Sequence[Row]) -> str:
        lines = [self.name, f"Error: {self.measure}; estimate: of it, from the same method's next finer run."]
        lines += [f"Reference: {y.source}; its own error about {y.uncertainty:.1e}." for y in self.yardsticks]
        lines += [f"Note: {note}." for note in self.notes]
        if len(rows) < len(self.rows):
            lines.append(f"Of {len(self.rows)} runs those that no other beats in both error and time:")
        if rows:
            heads = f"{'error':>10}{'estimate':>10}{'cpu':>10}{'evaluations':>13}"
            lines += ["", f"{'engine':8}{'method':14}{'setting':>20}{heads}"]
        for row in rows:
            knob = f"{row.knob} {row.setting:.3g}" + (" s" if row.knob == "step" else "")
            error = f"{row.error:.1e}" if math.isfinite(row.error) else "diverged"
            estimate = f"{row.estimate:.1e}" if math.isfinite(row.estimate) else "-"
            lines.append(
                f"{row.engine:8}{row.method:14}{knob:>20}{error:>10}{estimate:>10}{_seconds(row.cpu_s):>10}"
                f"{row.evaluations:>13}"
            )
        return "\n".join([*lines, "", self.recommendation(), ""])


def report(
    subject: Case | HardCase | Scene | Plan | mujoco.MjModel | str | Path,
    out_dir: str | Path | None = None,
    *,
    engines: Sequence[str] = ENGINES,
    budget_s: float = 0.5,
    limit_s: float = 120.0,
    progress: Callable[[str], None] | None = None,
) -> Report:
    """Compare engines and methods on one motion.

    Args:
        subject: a case, a hard case, a scene or its plan or file; a bare model swings from its first
            configuration for two seconds.
        out_dir: folder for table.csv, report.json, report.txt and report.png; nothing is written when None.
        engines: of "smooth", "mujoco" (the contact engine), "scipy" and "torch" (extra `torch`); the latter
            two get the smooth engine's equations. What cannot run the subject is named in the notes.
        budget_s: a method is refined until a run costs that much processor time [s], once at least.
        limit_s: no run begins after that much time on the clock [s]; what was left out is named.
        progress: told the method at work.

    A KeyboardInterrupt, once there are references, ends it with what was measured and status "interrupted".

    Raises:
        EngineError: an unknown engine, torch that is missing, or a reference that did not reach its end.
        RecordingError: `out_dir` cannot be written to; told before any work.
        SceneError: a scene with mistakes.
    """
    if out_dir is not None:
        check_writable(Path(out_dir))
    check_engines(engines)
    work = Work(engines, budget_s, time.perf_counter(), limit_s, progress)
    if isinstance(subject, HardCase | Case | mujoco.MjModel):
        result = _of_case(subject, work)
    else:
        plan = _plan(subject)
        if plan.engine.what == "kinematic":
            result = Report(scene_case(plan).name, (), (), (_KEYED,))
        elif is_free(plan):
            result = _of_case(scene_case(plan), work)
        else:
            result = _of_scene(plan, work)
    if out_dir is not None:
        result.write(out_dir)
    return result


def hard_suite(
    out_dir: str | Path | None = None,
    *,
    engines: Sequence[str] = ENGINES,
    budget_s: float = 0.5,
    limit_s: float = 120.0,
    progress: Callable[[str], None] | None = None,
) -> tuple[Report, ...]:
    """`report` for each of HARD_CASES against its known end, one folder a case in `out_dir`.

    `limit_s` is each case's; after an interrupt, the report of the case at work is the last.
    """
    reports: list[Report] = []
    for hard in HARD_CASES:
        folder = None if out_dir is None else Path(out_dir) / hard.name.replace(" ", "_").replace("'", "")

        def told(what: str, name: str = hard.name) -> None:
            if progress is not None:
                progress(f"{name}: {what}")

        found = report(hard, folder, engines=engines, budget_s=budget_s, limit_s=limit_s, progress=told)
        reports.append(found)
        if found.status == "interrupted":
            break
    return tuple(reports)


def _plan(subject: Scene | Plan | str | Path) -> Plan:
    from .plan import Plan, make_plan

    return subject if isinstance(subject, Plan) else make_plan(subject)


def _of_case(subject: Case | HardCase | mujoco.MjModel, work: Work) -> Report:
    hard = subject if isinstance(subject, HardCase) else None
    case = _case(subject)
    work.tell("compiling")
    smooth, why = smooth_or_none(case.model)
    notes = smooth.differences if smooth is not None else _without_smooth(why, work.engines)
    if hard is not None:
        error: Error = partial(hard.error, model=case.model)
        apart: Apart = partial(hard.apart, model=case.model)
        yardstick = Yardstick(hard.source, 1e-15)
    else:
        work.tell("the reference")
        if smooth is not None:
            reference = smooth_reference(case, smooth)
        else:
            reference = mujoco_reference(case, case.duration / case.frames / 2**10)
        error, apart = _against(case, reference), partial(trajectory_error, case)
        yardstick = _yardstick(reference)
    found = runners(case, smooth, work.engines)
    rows, left, status = work.sweeps(found, lambda _: (error, apart, yardstick.uncertainty))
    words = {} if hard is None else {"measure": f"error of {hard.observe} at the end, of its scale"}
    return Report(case.name, rows, (yardstick,), (*notes, *left), status=status, **words)


def _without_smooth(why: str, engines: Sequence[str]) -> tuple[str, ...]:
    """Notes on what a model without a smooth engine leaves out."""
    others = [e for e in engines if e in FOREIGN]
    notes = [f"no smooth engine: {why}"]
    return (*notes, *(f"no {other}: it solves the smooth engine's equations" for other in others))


def _case(subject: Case | HardCase | mujoco.MjModel) -> Case:
    if isinstance(subject, HardCase):
        return subject.case()
    if isinstance(subject, Case):
        return subject
    data = mujoco.MjData(subject)
    return Case("model", subject, data.qpos.copy(), data.qvel.copy(), 2.0)


def _of_scene(plan: Plan, work: Work) -> Report:
    case = scene_case(plan)
    work.tell("compiling")
    found, notes = scene_runners(plan, case, work.engines)
    engines = list(dict.fromkeys(physics(runner.engine) for runner in found))
    work.tell("the references")
    references = scene_references(engines, plan, case, budget_s=4 * work.budget_s, until=work.half)
    if len(references) == 2:
        gap = trajectory_error(case, references["smooth"].motion, references["contact"].motion)
        notes.append(f"the physics of the two engines lie {gap:.2g} rad or m apart, beside the errors below")

    def measures(runner: Runner) -> tuple[Error, Apart, float]:
        reference = references[physics(runner.engine)]
        return _against(case, reference), partial(trajectory_error, case), reference.uncertainty

    rows, left, status = work.sweeps(found, measures)
    order = list(dict.fromkeys(runner.engine for runner in found))
    rows = tuple(sorted(rows, key=lambda row: order.index(row.engine)))
    sticks = tuple(_yardstick(r, engine) for engine, r in references.items())
    return Report(case.name, rows, sticks, (*notes, *left), status=status)


def _yardstick(reference: Reference, engine: str = "") -> Yardstick:
    return Yardstick(reference.source, reference.uncertainty, engine, reference.sure_until)


def _against(case: Case, reference: Reference) -> Error:
    return lambda motion: trajectory_error(case, motion, reference.motion)


def _stiffness(rows: Sequence[Row]) -> list[str]:
    """A sentence when a loose tolerance costs an explicit method as much as a tight one."""
    methods = by_method(rows)
    loose = [row for row in methods.get(("smooth", "dopri5", "tolerance"), []) if row.setting in (1e-3, 1e-6)]
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
