"""How cost grows: time and memory along one axis at a time, and the exponents fitted to them."""

import csv
import io
import math
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from qgs.composer import Recipe, resolve
from qgs.memory import in_words
from qgs_bench.counting import count
from qgs_bench.memory import peak_memory
from qgs_bench.predict import PROCESS, RESERVE, available
from qgs_bench.run import in_turn, machine, quartiles
from qgs_bench.work import Operation, Workload, make_task, workload_of

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

    given: fields of the workload, as `workload_of` takes them. step: training steps too. rounds,
    warmup: of each time. keep: called with the report so far, after each axis. A point whose
    counted memory is more than is available is left out, and named with its reason. Returns the
    report, plain values for JSON. Raises as `bench` does.
    """
    operations: list[Operation] = ["forward", "step"] if step else ["forward"]
    series: list[dict[str, Any]] = []
    settings = {"overrides": [*overrides], "rounds": rounds, "warmup": warmup}
    report = {"report": KIND, "machine": machine(given["device"]), **settings, "series": series}
    for source in sources:
        for axis in axes:
            found: dict[Operation, list[dict[str, Any]]] = {o: [] for o in operations}
            missing: list[dict[str, Any]] = []
            for value in axis.values:
                recipe, work = at_point(source, overrides, axis.name, value, given)
                for operation in operations:
                    say(f"{source}: {operation}, {axis.name} {value}")
                    reason, counted = _too_large(recipe, operation, work)
                    if reason:
                        missing.append({"value": value, "operation": operation, "reason": reason})
                        continue
                    point = _measured(recipe, operation, work, rounds, warmup)
                    found[operation].append({"value": value, "counted_bytes": counted, **point})
            for operation, points in found.items():
                series.append(_series(source, axis.name, operation, points, missing))
            keep(report)
    return report


def _too_large(recipe: Recipe, operation: Operation, work: Workload) -> tuple[str, int]:
    """Why it is left out, or nothing; the bytes of its tensors."""
    counted = count(recipe, operation, replace(work, device="cpu")).peak
    needed = PROCESS[work.device] + round((1 + RESERVE) * counted)
    limit = available(work.device)
    if needed <= limit:
        return "", counted
    return f"needs {in_words(needed)}, {in_words(limit)} are available", counted


def _measured(
    recipe: Recipe, operation: Operation, work: Workload, rounds: int, warmup: int
) -> dict[str, Any]:
    """Seconds, and the peak of a fresh process."""
    peak = peak_memory(recipe, operation, work, torch.get_num_threads())
    task = make_task(operation, recipe, recipe.build_model(work.device), work)
    (samples,) = in_turn([task], rounds, warmup)
    return {"seconds": {**quartiles(samples), "samples": samples}, "memory": asdict(peak)}


def _series(
    source: str, axis: str, operation: Operation, points: list[Any], missing: list[Any]
) -> dict[str, Any]:
    values = [point["value"] for point in points]
    costs = {
        "seconds": [point["seconds"]["median"] for point in points],
        "peak_bytes": [p["memory"]["peak_bytes"] - p["memory"]["idle_bytes"] for p in points],
        "counted_bytes": [point["counted_bytes"] for point in points],
    }
    fits = {name: fit(values, found) for name, found in costs.items()}
    return {
        "recipe": source,
        "axis": axis,
        "operation": operation,
        "points": points,
        "left_out": [m for m in missing if m["operation"] == operation],
        "fits": {name: found and asdict(found) for name, found in fits.items()},
    }


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
