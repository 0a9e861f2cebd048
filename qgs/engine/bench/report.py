"""What was measured: one result per recipe, and what it was measured on."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from qgs.engine.bench.memory import Peak
from qgs.engine.bench.tasks import Operation
from qgs.engine.bench.timing import Spread
from qgs.engine.bench.workload import Workload
from qgs.io.atomic import write_text

KIND = "qgs bench"


@dataclass(frozen=True)
class Result:
    """One recipe. weight_bytes: of all parameters and saved buffers. times: seconds per call."""

    recipe: str
    workload: Workload
    queries: int
    gaussians: int
    parameters: int
    weight_bytes: int
    times: Mapping[Operation, Spread] = field(default_factory=dict)
    peaks: Mapping[Operation, Peak] = field(default_factory=dict)


@dataclass(frozen=True)
class Report:
    """All results, the first of which the others are compared with.

    machine: see `qgs.engine.bench.machine.describe`.
    """

    results: Sequence[Result]
    machine: Mapping[str, str | int]
    overrides: Sequence[str]
    rounds: int
    warmup: int

    def write(self, path: str | Path) -> None:
        """Write the report as JSON, whole or not at all."""
        write_text(path, json.dumps(self.as_json(), indent=2) + "\n")

    def as_json(self) -> dict[str, Any]:
        """Everything, each sample included; seconds and bytes."""
        settings = {"overrides": [*self.overrides], "rounds": self.rounds, "warmup": self.warmup}
        recipes = [_result(result, self.results[0]) for result in self.results]
        return {"report": KIND, "machine": dict(self.machine), **settings, "recipes": recipes}


def _result(result: Result, base: Result) -> dict[str, Any]:
    return {
        "recipe": result.recipe,
        **asdict(result.workload),
        "queries": result.queries,
        "gaussians": result.gaussians,
        "parameters": {
            "count": result.parameters,
            "weight_bytes": result.weight_bytes,
            "ratio": result.parameters / base.parameters,
        },
        "seconds": {
            operation: {
                **_quartiles(spread),
                "samples": [*spread.samples],
                "ratio": _quartiles(spread.over(base.times[operation])),
            }
            for operation, spread in result.times.items()
        },
        "memory": {
            operation: {
                **asdict(peak),
                "ratio": peak.peak_bytes / base.peaks[operation].peak_bytes,
            }
            for operation, peak in result.peaks.items()
        },
    }


def _quartiles(spread: Spread) -> dict[str, float]:
    return dict(zip(("lower_quartile", "median", "upper_quartile"), spread.quartiles, strict=True))


def refuse_other_file(path: Path) -> None:
    """Raise FileExistsError when `path` holds anything but an earlier report."""
    if not path.exists():
        return
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict) or found.get("report") != KIND:
        raise FileExistsError(
            f"{path} exists and is no report of `{KIND}`; choose another name for the report"
        )
