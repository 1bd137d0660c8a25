"""Work against precision: which engine and method reach which error at what cost, and what to take."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import mujoco

from .hard_cases import HARD_CASES, HardCase
from .recording import check_writable
from .scene_work import is_free, scene_case, scene_references, scene_runners
from .work_precision import SURE, Case, Motion, Reference, Row, Runner, by_method, sweep, trajectory_error
from .work_runners import mujoco_reference, runners, smooth_or_none, smooth_reference

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .plan import Plan
    from .scene.schema import Scene

Error: TypeAlias = Callable[[Motion], float]
Apart: TypeAlias = Callable[[Motion, Motion], float]

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
    """

    name: str
    rows: tuple[Row, ...]
    yardsticks: tuple[Yardstick, ...]
    notes: tuple[str, ...] = ()
    measure: str = "global error [rad, m]"

    def uncertainty(self, engine: str) -> float:
        """Error of the reference that an engine's rows are measured against."""
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
    progress: Callable[[str], None] | None = None,
) -> Report:
    """Compare engines and methods on one motion.

    Args:
        subject: a case, a hard case, a scene or its plan or file; a bare model swings from its first
            configuration for two seconds.
        out_dir: folder for table.csv, report.json, report.txt and report.png; nothing is written when None.
        engines: of "smooth", "mujoco", "scipy" and "torch" (extra `torch`), for free motion. A scene with
            keyed joints, servos, controllers or contacts runs on the smooth and the contact engine.
        budget_s: a method is refined until a run costs that much processor time [s].
        progress: told the method at work.

    Raises:
        EngineError: an unknown engine, or a reference that did not reach its end.
        RecordingError: `out_dir` cannot be written to; told before any work.
        SceneError: a scene with mistakes.
    """
    if out_dir is not None:
        check_writable(Path(out_dir))
    if isinstance(subject, HardCase | Case | mujoco.MjModel):
        result = _of_case(subject, engines, budget_s, progress)
    else:
        plan = _plan(subject)
        if plan.engine.what == "kinematic":
            result = Report(scene_case(plan).name, (), (), (_KEYED,))
        elif is_free(plan):
            result = _of_case(scene_case(plan), engines, budget_s, progress)
        else:
            result = _of_scene(plan, budget_s, progress)
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


def _plan(subject: Scene | Plan | str | Path) -> Plan:
    from .plan import Plan, make_plan

    return subject if isinstance(subject, Plan) else make_plan(subject)


def _of_case(
    subject: Case | HardCase | mujoco.MjModel,
    engines: Sequence[str],
    budget_s: float,
    progress: Callable[[str], None] | None,
) -> Report:
    hard = subject if isinstance(subject, HardCase) else None
    case = _case(subject)
    smooth, why = smooth_or_none(case.model)
    notes = (f"no smooth engine: {why}",) if smooth is None else smooth.differences
    if hard is not None:
        error: Error = partial(hard.error, model=case.model)
        apart: Apart = partial(hard.apart, model=case.model)
        yardstick = Yardstick(hard.source, 1e-15)
    else:
        if smooth is not None:
            reference = smooth_reference(case, smooth)
        else:
            reference = mujoco_reference(case, case.duration / case.frames / 2**10)
        error, apart = _against(case, reference), partial(trajectory_error, case)
        yardstick = _yardstick(reference)
    rows: list[Row] = []
    for runner in runners(case, smooth, engines):
        _tell(progress, runner)
        rows += sweep(runner, error, apart, floor=yardstick.uncertainty, budget_s=budget_s)
    words = {} if hard is None else {"measure": f"error of {hard.observe} at the end, of its scale"}
    return Report(case.name, tuple(rows), (yardstick,), notes, **words)


def _case(subject: Case | HardCase | mujoco.MjModel) -> Case:
    if isinstance(subject, HardCase):
        return subject.case()
    if isinstance(subject, Case):
        return subject
    data = mujoco.MjData(subject)
    return Case("model", subject, data.qpos.copy(), data.qvel.copy(), 2.0)


def _of_scene(plan: Plan, budget_s: float, progress: Callable[[str], None] | None) -> Report:
    case = scene_case(plan)
    found, notes = scene_runners(plan, case)
    engines = list(dict.fromkeys(runner.engine for runner in found))
    references = scene_references(engines, plan, case, budget_s=4 * budget_s)
    if len(references) == 2:
        gap = trajectory_error(case, references["smooth"].motion, references["contact"].motion)
        notes.append(f"the physics of the two engines lie {gap:.2g} rad or m apart, beside the errors below")
    rows: list[Row] = []
    for runner in found:
        _tell(progress, runner)
        reference = references[runner.engine]
        error, apart = _against(case, reference), partial(trajectory_error, case)
        rows += sweep(runner, error, apart, floor=reference.uncertainty, budget_s=budget_s)
    sticks = tuple(_yardstick(r, engine) for engine, r in references.items())
    return Report(case.name, tuple(rows), sticks, tuple(notes))


def _yardstick(reference: Reference, engine: str = "") -> Yardstick:
    return Yardstick(reference.source, reference.uncertainty, engine, reference.sure_until)


def _against(case: Case, reference: Reference) -> Error:
    return lambda motion: trajectory_error(case, motion, reference.motion)


def _tell(progress: Callable[[str], None] | None, runner: Runner) -> None:
    if progress is not None:
        progress(f"{runner.engine} {runner.method} by {runner.knob}")


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
