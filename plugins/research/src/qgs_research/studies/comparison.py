"""Two evaluations, scene by scene: mean differences, their uncertainty, wins and losses.

Several trainings of one recipe count as one side, whose interval then covers trainings too.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from qgs.contracts import Column
from qgs.evaluate.results import as_json, bullets, markdown_table, print_lines, print_table
from qgs.files import write_text
from qgs.wording import counted, listed, short_names
from qgs_research.studies.intervals import CONFIDENCE, CROSSED, RESAMPLES, SEED, interval
from qgs_research.studies.stored import COMPACT, StoredResults


@dataclass(frozen=True)
class Difference:
    """One metric over the scenes that both results have; differences are first minus second.

    trainings: number of paired runs; with one, low and high ignore the noise of training.
    low, high: the 95 % interval of the mean difference, None for fewer than two scenes.
    wins, losses: scenes in which the first is better, or worse; the rest are equal.
    """

    metric: str
    column: Column
    scenes: int
    trainings: int
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

    @property
    def title(self) -> str:
        """Who is compared, over how many scenes."""
        wanted, count = max(self.first.wanted, self.second.wanted), len(self.shared)
        scenes = counted(count, "scene") if count >= wanted else f"{count} of {wanted} scenes"
        return f"{self.first.name} against {self.second.name}, {scenes}"

    def record(self) -> dict[str, Any]:
        """Plain values for JSON."""
        first, second = self.first, self.second
        return {
            "first": first.name,
            "second": second.name,
            "steps": [[run.step for run in side.trainings] for side in (first, second)],
            "same_protocol": first.protocol.sha256 == second.protocol.sha256,
            "other_frames": list(self.moved),
            "differences": [asdict(difference) for difference in self.differences],
            "wanted": max(first.wanted, second.wanted),
            "missing_first": list(first.missing),
            "missing_second": list(second.missing),
            "null": list(dict.fromkeys([*first.null, *second.null])),
            "only_first": [name for name in first.scenes if name not in self.shared],
            "only_second": [name for name in second.scenes if name not in self.shared],
        }

    def rows(self) -> list[list[str]]:
        """The table, headers first; one digit finer than an evaluation's."""
        names = short_names([self.first.name, self.second.name])
        rows = [["metric", *names, "difference", "95 % interval", "won : lost"]]
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
        pairs, steps = _trainings(first, second), list[float]()
        covered = f"{len(pairs)} trainings a side and scenes, both random ({CROSSED})"
        if len(pairs) == 1:
            counts = len(first.trainings), len(second.trainings)
            sides = "{} against {} trainings".format(*counts)
            covered = (
                f"scenes alone (percentile bootstrap, {RESAMPLES:,} resamples); "
                f"{'one training a side' if sum(counts) == 2 else sides}: says nothing of training"
            )
        yield f"difference: {first.name} minus {second.name}, mean over scenes; interval: {covered}"
        for side in (first, second):
            steps.append(float(np.mean([run.step for run in side.trainings if run.step] or [0])))
            seeds = listed(run.seed for run in side.trainings if run.seed is not None)
            of = f" of a budget of {side.budget}, seed {seeds}" if side.budget else ""
            known = f"{steps[-1]:,.0f} steps" if steps[-1] else "steps not known"
            yield f"{side.name}: {known}{of}"
        for side, paired in zip((first, second), zip(*pairs, strict=True), strict=True):
            left = [run.seed for run in side.runs if all(run is not other for other in paired)]
            if len(pairs) > 1 and left:
                yield f"{side.name}: seed {listed(left)} left out, nothing to pair with"
        if min(steps) and max(steps) > 1.02 * min(steps):
            yield f"unequal training: {max(steps) / min(steps):.2f} times the steps of the other"
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
        if alone := first.columns.keys() ^ second.columns.keys():
            yield f"not in both, left out: {listed(sorted(alone))}"
        if not facts["same_protocol"]:
            yield "the protocols differ: the scores do not measure the same"
        if self.moved:
            yield f"{len(self.moved)} scenes judged on different frames: {listed(self.moved)}"


@dataclass(frozen=True)
class Comparisons:
    """The first results against each of the others."""

    pairs: Sequence[Comparison]

    @property
    def protocols(self) -> dict[str, str]:
        """Name and hash of the protocol of each result."""
        every = [self.pairs[0].first, *(pair.second for pair in self.pairs)]
        return {r.name: f"{r.protocol.name}, sha256 {r.protocol.sha256}" for r in every}

    def show(self, console: Console) -> None:
        """Print a table for each pair."""
        for pair in self.pairs:
            print_table(console, pair.title, pair.rows(), **COMPACT)
            print_lines(console, pair.notes())
        print_lines(console, self._protocol_lines())

    def write(self, folder: Path) -> None:
        """Write comparison.json and comparison.md into `folder`."""
        record = {
            "protocols": self.protocols,
            "bootstrap": {"resamples": RESAMPLES, "confidence": CONFIDENCE, "seed": SEED},
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
    results = grouped(results)
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
                f"which differ in {', '.join(unequal)}: evaluate both by one protocol, or add "
                "--across-protocols to compare them all the same"
            )
        shared = [name for name in first.scenes if name in other.scenes]
        if not shared:
            raise ValueError(f"{first.name} and {other.name} have no scene in common")
        every = [*first.trainings, *other.trainings]
        moved = [name for name in shared if len({run.frames[name] for run in every}) > 1]
        if moved and not across_protocols:
            raise ValueError(
                f"{first.name} and {other.name} judged {len(moved)} scenes on different frames, "
                f"although their protocols agree: {listed(moved)}. The data, or how views are "
                "drawn, changed between them: evaluate both again, or add --across-protocols"
            )
        metrics = [name for name in first.columns if name in other.columns]
        found = (_difference(metric, first, other, shared) for metric in metrics)
        pairs.append(Comparison(first, other, shared, moved, [d for d in found if d]))
    return Comparisons(pairs)


def grouped(results: Sequence[StoredResults]) -> Sequence[StoredResults]:
    """Trainings of one recipe with several seeds as one result, where there are others too.

    Its values are means over its `runs`, of the scenes that all of them judged.
    """
    groups: dict[Any, list[StoredResults]] = {}
    for number, result in enumerate(results):
        key = (result.recipe, result.protocol.sha256) if result.recipe else number
        groups.setdefault(key, []).append(result)
    if len(groups) < 2:
        return results
    sides = list[StoredResults]()
    for runs in groups.values():
        several = len({run.seed for run in runs}) == len(runs) > 1
        sides += [_mean(runs)] if several else runs
    names = [side.name for side in sides]  # of several in one folder, all of their runs
    return [
        replace(side, name=", ".join(run.name for run in side.trainings))
        if names.count(side.name) > 1
        else side
        for side in sides
    ]


def _mean(runs: Sequence[StoredResults]) -> StoredResults:
    first, names = runs[0], [run.name for run in runs]
    scenes = {
        scene: {
            key: float(np.mean([run.scenes[scene][key] for run in runs]))
            for key in values
            if all(key in run.scenes[scene] for run in runs)
        }
        for scene, values in first.scenes.items()
        if all(scene in run.scenes for run in runs)
    }
    folder = os.path.commonpath(names) if len({*map(os.path.isabs, names)}) == 1 else ""
    return replace(first, name=folder or ", ".join(names), scenes=scenes, runs=tuple(runs))


def _difference(
    metric: str, first: StoredResults, second: StoredResults, shared: Sequence[str]
) -> Difference | None:
    """None where no scene has the metric in both."""
    column, value = first.columns[metric], f"model_{metric}"
    pairs = _trainings(first, second)
    every = [run for pair in pairs for run in pair]
    scenes = [name for name in shared if all(value in run.scenes.get(name, ()) for run in every)]
    if not scenes:
        return None
    values = np.array(
        [[[run.scenes[name][value] for name in scenes] for run in pair] for pair in pairs]
    )
    apart = values[:, 0] - values[:, 1]
    better = apart.mean(0) if column.better == "higher" else -apart.mean(0)
    low, high = interval(apart)
    return Difference(
        metric=metric,
        column=column,
        scenes=len(scenes),
        trainings=len(pairs),
        first=float(values[:, 0].mean()),
        second=float(values[:, 1].mean()),
        difference=float(apart.mean()),
        low=low,
        high=high,
        wins=int((better > 0).sum()),
        losses=int((better < 0).sum()),
    )


def _trainings(
    first: StoredResults, second: StoredResults
) -> Sequence[tuple[StoredResults, StoredResults]]:
    """Pairs of equal seeds, else in their order; the means where a side has a single training."""
    ours, theirs = ({run.seed: run for run in side.runs} for side in (first, second))
    if len(common := [seed for seed in ours if seed in theirs]) > 1:
        return [(ours[seed], theirs[seed]) for seed in common]
    if min(len(ours), len(theirs)) > 1:
        return [*zip(ours.values(), theirs.values(), strict=False)]
    return [(first, second)]
