"""Two evaluations, scene by scene: mean differences, their uncertainty, wins and losses."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console

from qgs.contracts import Column
from qgs.engine.results import (
    StoredResults,
    as_json,
    bullets,
    markdown_table,
    print_lines,
    print_table,
)
from qgs.io.files import write_text
from qgs.wording import listed

RESAMPLES = 10_000
CONFIDENCE = 0.95
_SEED = 0
_AT_A_TIME = 1_000_000  # numbers that the bootstrap draws, which bounds its memory


@dataclass(frozen=True)
class Difference:
    """One metric over the scenes that both results have; differences are first minus second.

    low, high: the 95 % interval of the mean difference over scenes, None for fewer than two.
    wins, losses: scenes in which the first is better, or worse; the rest are equal.
    """

    metric: str
    column: Column
    scenes: int
    first: float
    second: float
    difference: float
    low: float | None
    high: float | None
    wins: int
    losses: int


@dataclass(frozen=True)
class Comparison:
    """Two results. shared: the scenes that both judged. moved: those on different frames."""

    first: StoredResults
    second: StoredResults
    shared: Sequence[str]
    moved: Sequence[str]
    differences: Sequence[Difference]

    def record(self) -> dict[str, Any]:
        """Plain values for JSON. empty: headings of metrics that have no scene in both."""
        first, second = self.first, self.second
        compared = {difference.metric for difference in self.differences}
        columns = {**first.columns, **second.columns}
        return {
            "first": first.name,
            "second": second.name,
            "same_protocol": first.protocol.sha256 == second.protocol.sha256,
            "other_frames": list(self.moved),
            "differences": [asdict(difference) for difference in self.differences],
            "wanted": max(first.wanted, second.wanted),
            "missing_first": list(first.missing),
            "missing_second": list(second.missing),
            "null": list(dict.fromkeys([*first.null, *second.null])),
            "only_first": [name for name in first.scenes if name not in self.shared],
            "only_second": [name for name in second.scenes if name not in self.shared],
            "empty": [column.heading for name, column in columns.items() if name not in compared],
        }

    @property
    def title(self) -> str:
        """Who is compared, over how many scenes."""
        first, second, count = self.first, self.second, len(self.shared)
        scenes = f"{count} scene{'s' if count > 1 else ''}"
        if count < (wanted := max(first.wanted, second.wanted)):
            missing = list(dict.fromkeys([*first.missing, *second.missing]))
            names = f" (missing: {listed(missing)})" if missing else ""
            scenes = f"{count} of {wanted} scenes{names}"
        return f"{first.name} against {second.name}, {scenes}"

    def rows(self) -> list[list[str]]:
        """The table, headers first; one digit finer than an evaluation's."""
        rows = [["metric", "first", "second", "difference", "95 % interval", "won : lost"]]
        for d in self.differences:
            digits = d.column.digits + 1
            means = [f"{d.first:.{digits}f}", f"{d.second:.{digits}f}"]
            change = f"{d.difference:+.{digits}f}"
            ends = "–" if d.low is None else f"[{d.low:+.{digits}f}, {d.high:+.{digits}f}]"
            rows.append([d.column.title, *means, change, ends, f"{d.wins} : {d.losses}"])
        return rows

    def notes(self) -> Iterator[str]:
        """What is to be known beside the table, one line each."""
        first, second, facts = self.first, self.second, self.record()
        yield (
            f"difference: {first.name} minus {second.name}, mean over scenes; interval: percentile "
            f"bootstrap over scenes, {RESAMPLES:,} resamples"
        )
        if len(self.shared) == 1:
            yield "one scene is too few for an interval"
        if null := facts["null"]:
            yield f"null entries of the index, not judged ({len(null)}): {listed(null)}"
        for result, only in ((first, facts["only_first"]), (second, facts["only_second"])):
            if result.missing:
                yield f"{result.name} is incomplete: no score of {listed(result.missing)}"
            if only:
                yield f"{len(only)} scenes only in {result.name}, left out: {listed(only)}"
        for d in self.differences:
            if d.scenes < len(self.shared):
                yield f"{d.column.heading}: over the {d.scenes} scenes that have it in both"
            if d.column.heading != (other := second.columns[d.metric].heading):
                yield f"{d.column.heading} in {first.name} is {other} in {second.name}"
        if facts["empty"]:
            yield f"not in both, left out: {', '.join(facts['empty'])}"
        if not facts["same_protocol"]:
            yield "the protocols differ: the scores do not measure the same"
        if self.moved:
            yield f"{len(self.moved)} scenes judged on different frames: {listed(self.moved)}"


@dataclass(frozen=True)
class Comparisons:
    """The first results against each other. protocols: result to its protocol's name and hash."""

    protocols: Mapping[str, str]
    pairs: Sequence[Comparison]

    def show(self, console: Console) -> None:
        """Print a table for each pair."""
        compact = {"box": box.SIMPLE_HEAD, "collapse_padding": True, "pad_edge": False}
        for pair in self.pairs:
            print_table(console, pair.title, pair.rows(), **compact)
            print_lines(console, pair.notes())
        print_lines(console, self._protocol_lines())

    def write(self, folder: Path) -> None:
        """Write comparison.json and comparison.md into `folder`."""
        record = {
            "protocols": dict(self.protocols),
            "bootstrap": {"resamples": RESAMPLES, "confidence": CONFIDENCE, "seed": _SEED},
            "pairs": [pair.record() for pair in self.pairs],
        }
        write_text(folder / "comparison.json", as_json(record))
        write_text(folder / "comparison.md", self.markdown())

    def markdown(self) -> str:
        """The tables and what is to be known beside them."""
        parts = []
        for pair in self.pairs:
            parts += [f"**{pair.title}**", markdown_table(pair.rows()), bullets(pair.notes())]
        return "\n\n".join([*parts, bullets(self._protocol_lines())]) + "\n"

    def _protocol_lines(self) -> list[str]:
        if len(same := set(self.protocols.values())) == 1:
            return [f"protocol {same.pop()}"]
        return [f"protocol of {name}: {protocol}" for name, protocol in self.protocols.items()]


def compare(results: Sequence[StoredResults], across_protocols: bool = False) -> Comparisons:
    """Compare the first of `results` with each of the others.

    Raises ValueError for fewer than two, one folder twice and no scene in common, and unless
    `across_protocols` for different protocols and scenes judged on different frames.
    """
    names = [result.name for result in results]
    if len(names) < 2 or len(set(names)) < len(names):
        raise ValueError(f"a comparison takes two or more different results, got {names}")
    first, *others = results
    pairs = []
    for other in others:
        if other.protocol.sha256 != first.protocol.sha256 and not across_protocols:
            ours, theirs = first.protocol.content, other.protocol.content
            unequal = sorted(k for k in {*ours, *theirs} if ours.get(k) != theirs.get(k))
            raise ValueError(
                f"{first.name} was judged by {first.protocol}, {other.name} by {other.protocol}, "
                f"which differ in {', '.join(unequal)}: evaluate both alike, or add "
                "--across-protocols to compare them all the same"
            )
        shared = [name for name in first.scenes if name in other.scenes]
        if not shared:
            raise ValueError(f"{first.name} and {other.name} have no scene in common")
        moved = [name for name in shared if first.frames[name] != other.frames[name]]
        if moved and not across_protocols:
            raise ValueError(
                f"{first.name} and {other.name} judged {len(moved)} scenes on different frames, "
                f"although their protocols agree: {listed(moved)}. The data, or how views are "
                "drawn, changed between them: evaluate both again, or add --across-protocols"
            )
        metrics = [name for name in first.columns if name in other.columns]
        found = (_difference(metric, first, other, shared) for metric in metrics)
        pairs.append(Comparison(first, other, shared, moved, [d for d in found if d]))
    protocols = {r.name: f"{r.protocol.name}, sha256 {r.protocol.sha256}" for r in results}
    return Comparisons(protocols, pairs)


def paired_interval(differences: np.ndarray) -> tuple[float, float] | None:
    """Percentile bootstrap interval of the mean of differences (S,), one per scene.

    The same for the same numbers: the resamples are seeded. None for fewer than two scenes.
    """
    count = len(differences)
    if count < 2:
        return None
    rng = np.random.default_rng(_SEED)
    step = max(_AT_A_TIME // count, 1)
    sizes = [min(step, RESAMPLES - start) for start in range(0, RESAMPLES, step)]
    drawn = [differences[rng.integers(0, count, (size, count))].mean(1) for size in sizes]
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(np.concatenate(drawn), [tail, 1 - tail])
    return float(low), float(high)


def _difference(
    metric: str, first: StoredResults, second: StoredResults, shared: Sequence[str]
) -> Difference | None:
    """None where no scene has the metric in both."""
    column, value = first.columns[metric], f"model_{metric}"
    scenes = [(first.scenes[name], second.scenes[name]) for name in shared]
    values = np.array([[a[value], b[value]] for a, b in scenes if value in a and value in b])
    if not len(values):
        return None
    apart = values[:, 0] - values[:, 1]
    better = apart if column.better == "higher" else -apart
    low, high = paired_interval(apart) or (None, None)
    return Difference(
        metric=metric,
        column=column,
        scenes=len(values),
        first=float(values[:, 0].mean()),
        second=float(values[:, 1].mean()),
        difference=float(apart.mean()),
        low=low,
        high=high,
        wins=int((better > 0).sum()),
        losses=int((better < 0).sum()),
    )
