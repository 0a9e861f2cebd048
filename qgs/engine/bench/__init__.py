"""How fast and how large models are: any number of recipes, measured in turn in one run."""

from qgs.engine.bench.memory import Peak, peak_memory
from qgs.engine.bench.run import Measures, Report, Result, Spread, Subject, bench, in_turn
from qgs.engine.bench.work import Workload, workload_of

__all__ = [
    "Measures",
    "Peak",
    "Report",
    "Result",
    "Spread",
    "Subject",
    "Workload",
    "bench",
    "in_turn",
    "peak_memory",
    "workload_of",
]
