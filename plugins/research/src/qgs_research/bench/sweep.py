"""Time and memory along one axis at a time, and the exponents fitted to them."""

import math
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from qgs.recipe import resolve
from qgs_research.bench.memory import peak_memory
from qgs_research.bench.run import KIND, in_turn, machine, quartiles
from qgs_research.bench.work import Operation, make_task, workload_of

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
    if match is None or match[1] not in AXES or int(match[3]) < 2 * int(match[2]):
        raise ValueError(
            f"--sweep must be AXIS=FIRST..LAST, such as views=2..32, with an axis of "
            f"{', '.join(AXES)} and LAST at least twice FIRST; got {text!r}"
        )
    first, last = int(match[2]), int(match[3])
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


def measure_sweep(
    names: Sequence[str],
    axes: Sequence[Axis],
    work: Mapping[str, Any],
    *,
    step: bool = False,
    rounds: int = 10,
    warmup: int = 2,
    overrides: Sequence[str] = (),
    say: Callable[[str], None] = lambda _: None,
    keep: Callable[[dict[str, Any]], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure all recipes along all axes, each from the recipe's own values of the others.

    Peak memory is that of a fresh process. Recipes that failed there are listed with the error; the
    others take turns, round by round. Options as in `measure_recipes`; keep: called with the report
    after each point. Returns the report, plain values for JSON.
    """
    operations: list[Operation] = ["forward", "step"] if step else ["forward"]
    points: list[dict[str, Any]] = []
    failed: list[dict[str, Any]] = []
    report = {"report": KIND, "machine": machine(work["device"]), "overrides": [*overrides]}
    report |= {"rounds": rounds, "warmup": warmup, "points": points, "failed": failed}
    for axis, value in [(one.name, value) for one in axes for value in one.values]:
        for operation in operations:
            say(label := f"{axis} {value}: {operation}, ")
            entries: list[dict[str, Any]] = []
            tasks = []
            for name in names:
                entry = {"recipe": name, "axis": axis, "value": value, "operation": operation}
                try:
                    recipe, load = _at(name, overrides, axis, value, work)
                    peak = peak_memory(recipe, operation, load, torch.get_num_threads())
                    model = recipe.build_model(load.device)
                    tasks.append(make_task(operation, recipe, model, load))
                    entries.append(entry | {"memory": asdict(peak)})
                # ChildProcessError, or what a component raises at sizes it was not made for.
                except Exception as error:
                    reason = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
                    failed.append(entry | {"reason": reason})
            columns = in_turn(tasks, rounds, warmup, say, label)
            for entry, samples in zip(entries, columns, strict=True):
                points.append(entry | {"seconds": {**quartiles(samples), "samples": samples}})
        report["fits"] = [*_fits(points)]
        keep(report)
    return report


def _at(name: str, overrides: Sequence[str], axis: str, value: int, work: Mapping[str, Any]) -> Any:
    """The recipe and the workload of one point."""
    changed = [f"model.queries.count={value}"] if axis == "queries" else []
    recipe = resolve(name, [*overrides, *changed])
    at: dict[str, Any] = {"size": (value, value)} if axis == "size" else {axis: value}
    return recipe, workload_of(recipe, **{**work, **({} if changed else at)})


def series_of(points: Sequence[dict[str, Any]]) -> dict[tuple[str, str, str], list[dict[str, Any]]]:
    """Points by recipe, axis and operation."""
    found: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for point in points:
        found.setdefault((point["recipe"], point["axis"], point["operation"]), []).append(point)
    return found


def _fits(points: Sequence[dict[str, Any]]) -> Any:
    for (recipe, axis, operation), series in series_of(points).items():
        values = [point["value"] for point in series]
        costs = {
            "seconds": [p["seconds"]["median"] for p in series],
            # A process holds Python and torch before the model; they would hide the growth.
            "bytes": [p["memory"]["peak_bytes"] - p["memory"]["idle_bytes"] for p in series],
        }
        fits = {cost: fit(values, of_series) for cost, of_series in costs.items()}
        entry = {"recipe": recipe, "axis": axis, "operation": operation}
        yield entry | {cost: found and asdict(found) for cost, found in fits.items()}
