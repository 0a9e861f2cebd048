"""How cost grows: time and memory along one axis at a time, and the exponents fitted to them."""

import csv
import io
import math
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import torch

from qgs.composer import Recipe, resolve
from qgs.memory import in_words
from qgs_bench.counting import Counted, count
from qgs_bench.memory import Peak, peak_memory
from qgs_bench.predict import PROCESS, RESERVE, available
from qgs_bench.run import in_turn, machine, quartiles
from qgs_bench.work import Operation, Task, Workload, make_task, workload_of

KIND = "qgs bench --sweep"

AXES: Mapping[str, str] = {
    "views": "input views",
    "queries": "queries",
    "size": "height and width, pixels",
    "batch": "scenes at once",
}


@dataclass(frozen=True)
class Axis:
    """values: of `name`, one of AXES, ascending, each twice the one before."""

    name: str
    values: tuple[int, ...]


@dataclass(frozen=True)
class Fit:
    """cost = factor * value ** exponent, by least squares of logarithms. error: the standard error
    of the exponent; None with two points. last: the exponent between the last two points."""

    exponent: float
    error: float | None
    factor: float
    last: float


def parse_axis(text: str) -> Axis:
    """The axis of "views=2..32": 2, 4, ... up to 32. Raises ValueError for anything else."""
    match = re.fullmatch(r"(\w+)=([1-9]\d*)\.\.([1-9]\d*)", text)
    if match is None or match[1] not in AXES:
        raise ValueError(
            f"--sweep must be AXIS=FIRST..LAST, such as views=2..32, with an axis of "
            f"{', '.join(AXES)}; got {text!r}"
        )
    first, last = int(match[2]), int(match[3])
    if last < 2 * first:
        raise ValueError(
            f"--sweep {text} has one point, because each is twice the one before: the last must be "
            f"at least {2 * first}"
        )
    return Axis(match[1], tuple(first * 2**n for n in range((last // first).bit_length())))


def fit(values: Sequence[float], costs: Sequence[float]) -> Fit | None:
    """See `Fit`; None for fewer than two points."""
    if len(values) < 2:
        return None
    x, y = [math.log(v) for v in values], [math.log(c) for c in costs]
    exponent, intercept = statistics.linear_regression(x, y)
    error = None
    if len(x) > 2:
        left = [b - exponent * a - intercept for a, b in zip(x, y, strict=True)]
        spread = sum((a - statistics.fmean(x)) ** 2 for a in x)
        error = math.sqrt(sum(r * r for r in left) / (len(x) - 2) / spread)
    last = (y[-1] - y[-2]) / (x[-1] - x[-2])
    return Fit(exponent, error, math.exp(intercept), last)


def at_point(
    source: str, overrides: Sequence[str], axis: str, value: int, given: Mapping[str, Any]
) -> tuple[Recipe, Workload]:
    """The recipe and the work of one point. given: as `workload_of` takes it."""
    changed = [f"model.queries.count={value}"] if axis == "queries" else []
    recipe = resolve(source, [*overrides, *changed])
    work = workload_of(recipe, **given)
    if axis in ("views", "batch"):
        work = replace(work, **{axis: value})
    elif axis == "size":
        work = replace(work, size=(value, value))
    return recipe, work


def sweep(
    sources: Sequence[str],
    axes: Sequence[Axis],
    given: Mapping[str, Any],
    *,
    step: bool = False,
    rounds: int = 10,
    warmup: int = 2,
    overrides: Sequence[str] = (),
    say: Callable[[str], None] = lambda _: None,
    keep: Callable[[dict[str, Any]], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure all recipes along all axes, each from the recipe's own values of the others.

    At each point the recipes take turns, round by round. given: fields of the workload, as
    `workload_of` takes them. step: training steps too. rounds, warmup: of each time. keep: called
    with the report so far, after each point. A recipe whose counted memory is more than is
    available is left out of a point, one that raises there has failed; both are named with the
    reason, and the others go on. Returns the report, plain values for JSON. Raises as `resolve`
    does, before anything is measured.
    """
    operations: list[Operation] = ["forward", "step"] if step else ["forward"]
    settings = {"overrides": [*overrides], "rounds": rounds, "warmup": warmup}
    plan = {
        (axis.name, value): [at_point(s, overrides, axis.name, value, given) for s in sources]
        for axis in axes
        for value in axis.values
    }
    series = {
        (number, axis.name, operation): _Series(source, axis.name, operation)
        for number, source in enumerate(sources)
        for axis in axes
        for operation in operations
    }

    def report() -> dict[str, Any]:
        found = [one.as_dict() for one in series.values()]
        head = {"report": KIND, "machine": machine(given["device"]), **settings}
        return {**head, "series": found}

    for (axis, value), works in plan.items():
        for operation in operations:
            runs = [_Run(*work, operation) for work in works]
            _measure(runs, rounds, warmup, say, f"{axis} {value}: {operation}, ")
            for number, run in enumerate(runs):
                series[number, axis, operation].add(value, run)
        keep(report())
    return report()


@dataclass
class _Run:
    """A recipe at a point. missing: "left_out" or "failed", and why, if it was not measured."""

    recipe: Recipe
    work: Workload
    operation: Operation
    counted: Counted | None = None
    peak: Peak | None = None
    task: Task | None = None
    samples: Sequence[float] = ()
    missing: tuple[str, str] | None = None

    def count(self) -> None:
        self.counted = count(self.recipe, self.operation, replace(self.work, device="cpu"))

    def measure_peak(self) -> None:
        self.peak = peak_memory(self.recipe, self.operation, self.work, torch.get_num_threads())

    def make(self) -> None:
        model = self.recipe.build_model(self.work.device)
        self.task = make_task(self.operation, self.recipe, model, self.work)

    def call(self) -> None:
        assert self.task is not None
        self.task()

    def attempt(self, action: Callable[["_Run"], None]) -> None:
        """Do it, unless something went wrong before; what goes wrong is kept as the reason."""
        if self.missing is None:
            try:
                action(self)
            except Exception as error:
                first = str(error).strip().partition("\n")[0]
                self.missing = "failed", f"{type(error).__name__}: {first}"
                self.task = None  # gives its memory to the others


def _measure(
    runs: Sequence[_Run], rounds: int, warmup: int, say: Callable[[str], None], label: str
) -> None:
    """Memory of each in a fresh process, then time of all in turn."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()  # of the point before, which would not count as free
    say(f"{label}memory")
    for run in runs:
        run.attempt(_Run.count)
    _leave_out(runs)
    for action in (_Run.measure_peak, _Run.make):
        for run in runs:
            run.attempt(action)
    tasks = [partial(run.attempt, _Run.call) for run in runs]
    columns = in_turn(tasks, rounds, warmup, say, label)
    for run, samples in zip(runs, columns, strict=True):
        run.samples, run.task = samples, None


def _leave_out(runs: Sequence[_Run]) -> None:
    """Leave out what does not fit into memory beside what those before it keep between calls."""
    kept = most = 0
    for run in runs:
        if (found := run.counted) is None:
            continue
        own = found.weights + found.inputs + found.gradients + found.moments
        tensors = kept + own + max(most, found.peak - own)
        needed = PROCESS[run.work.device] + round((1 + RESERVE) * tensors)
        limit = available(run.work.device)
        if needed > limit:
            beside = " with the recipes before it" if kept else ""
            told = f"needs {in_words(needed)}{beside}, {in_words(limit)} are available"
            run.missing = "left_out", told
        else:
            kept, most = kept + own, max(most, found.peak - own)


@dataclass
class _Series:
    """What was found of a recipe along an axis; left_out and failed name points with reasons."""

    recipe: str
    axis: str
    operation: Operation
    points: list[dict[str, Any]] = field(default_factory=list)
    left_out: list[dict[str, Any]] = field(default_factory=list)
    failed: list[dict[str, Any]] = field(default_factory=list)

    def add(self, value: int, run: _Run) -> None:
        """Add what a run has found."""
        if run.missing is not None:
            kind, reason = run.missing
            missing = {"value": value, "operation": self.operation, "reason": reason}
            (self.left_out if kind == "left_out" else self.failed).append(missing)
            return
        assert run.counted is not None
        assert run.peak is not None
        seconds = {**quartiles(run.samples), "samples": [*run.samples]}
        memory = {"counted_bytes": run.counted.peak, "memory": asdict(run.peak)}
        self.points.append({"value": value, "seconds": seconds, **memory})

    def as_dict(self) -> dict[str, Any]:
        """With the fits, for the report."""
        values = [point["value"] for point in self.points]
        costs = {
            "seconds": [p["seconds"]["median"] for p in self.points],
            "peak_bytes": [
                p["memory"]["peak_bytes"] - p["memory"]["idle_bytes"] for p in self.points
            ],
            "counted_bytes": [p["counted_bytes"] for p in self.points],
        }
        fits = {name: fit(values, found) for name, found in costs.items()}
        return asdict(self) | {"fits": {n: found and asdict(found) for n, found in fits.items()}}


def as_csv(report: Mapping[str, Any]) -> str:
    """A line for each point: recipe, axis, value, operation, seconds and bytes."""
    names = ("recipe", "axis", "value", "operation", "seconds", "peak_bytes", "counted_bytes")
    lines = [names]
    for series in report["series"]:
        for point in series["points"]:
            cost = (point["seconds"]["median"], point["memory"]["peak_bytes"])
            head = (series["recipe"], series["axis"], point["value"], series["operation"])
            lines.append((*head, *cost, point["counted_bytes"]))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()
