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
from qgs_research.studies.stored import COMPACT, StoredResults, scenes_with

Pairs = Sequence[tuple[StoredResults, StoredResults]]


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

    def cells(self) -> list[str]:
        """A row of the table, one digit finer than an evaluation's."""
        # Differences are smaller than what an evaluation rounds to.
        digits = self.column.digits + 1
        interval = "–"
        if self.low is not None:
            interval = f"[{self.low:+.{digits}f}, {self.high:+.{digits}f}]"
        return [
            self.column.title,
            f"{self.first:.{digits}f}",
            f"{self.second:.{digits}f}",
            f"{self.difference:+.{digits}f}",
            interval,
            f"{self.wins} : {self.losses}",
        ]


@dataclass(frozen=True)
class Comparison:
    """Two results. shared: the scenes that both judged. moved: those on different frames.

    pairs: the trainings that are held against each other, see `paired_trainings`.
    """

    first: StoredResults
    second: StoredResults
    shared: Sequence[str]
    moved: Sequence[str]
    pairs: Pairs
    differences: Sequence[Difference]

    @property
    def title(self) -> str:
        """Who is compared, over how many scenes."""
        # An index may have grown between two evaluations.
        wanted = max(self.first.wanted, self.second.wanted)
        count = len(self.shared)
        scenes = counted(count, "scene") if count >= wanted else f"{count} of {wanted} scenes"
        return f"{self.first.name} against {self.second.name}, {scenes}"

    def record(self) -> dict[str, Any]:
        """Plain values for JSON."""
        first = self.first
        second = self.second
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
        """The table, headers first."""
        names = short_names([self.first.name, self.second.name])
        head = ["metric", *names, "difference", "95 % interval", "won : lost"]
        return [head, *(difference.cells() for difference in self.differences)]

    def notes(self) -> Iterator[str]:
        """What is to be known beside the table, one line each."""
        names = f"{self.first.name} minus {self.second.name}"
        yield f"difference: {names}, mean over scenes; interval: {self._covers()}"
        steps = []
        facts = self.record()
        for place, side in enumerate((self.first, self.second)):
            steps.append(float(np.mean([run.step for run in side.trainings if run.step] or [0])))
            seeds = listed(run.seed for run in side.trainings if run.seed is not None)
            budget = f" of a budget of {side.budget}, seed {seeds}" if side.budget else ""
            known = f"{steps[-1]:,.0f} steps" if steps[-1] else "steps not known"
            yield f"{side.name}: {known}{budget}"
            paired = {pair[place].seed for pair in self.pairs}
            left = [run.seed for run in side.runs if run.seed not in paired]
            if len(self.pairs) > 1 and left:
                yield f"{side.name}: seed {listed(left)} left out, nothing to pair with"
            if side.missing:
                yield f"{side.name} is incomplete: no score of {listed(side.missing)}"
            if only := facts[("only_first", "only_second")[place]]:
                yield f"{len(only)} scenes only in {side.name}, left out: {listed(only)}"
        # Two runs of one budget in seconds differ by a little.
        if min(steps) and max(steps) > 1.02 * min(steps):
            yield f"unequal training: {max(steps) / min(steps):.2f} times the steps of the other"
        if len(self.shared) == 1:
            yield "one scene is too few for an interval"
        if null := facts["null"]:
            yield f"null entries of the index, not judged ({len(null)}): {listed(null)}"
        for difference in self.differences:
            if difference.scenes < len(self.shared):
                heading = difference.column.heading
                yield f"{heading}: over the {difference.scenes} scenes that have it in both"
        if alone := self.first.columns.keys() ^ self.second.columns.keys():
            yield f"not in both, left out: {listed(sorted(alone))}"
        if not facts["same_protocol"]:
            yield "the protocols differ: the scores do not measure the same"
        if self.moved:
            yield f"{len(self.moved)} scenes judged on different frames: {listed(self.moved)}"

    def _covers(self) -> str:
        """What the intervals are over."""
        if len(self.pairs) > 1:
            return f"{len(self.pairs)} trainings a side and scenes, both random ({CROSSED})"
        counts = (len(self.first.trainings), len(self.second.trainings))
        sides = "one training a side" if max(counts) == 1 else "{} against {} trainings"
        bootstrap = f"scenes alone (percentile bootstrap, {RESAMPLES:,} resamples)"
        return f"{bootstrap}; {sides.format(*counts)}: says nothing of training"


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
    return Comparisons([_compared(first, other, across_protocols) for other in others])


def _compared(first: StoredResults, second: StoredResults, across_protocols: bool) -> Comparison:
    if second.protocol.sha256 != first.protocol.sha256 and not across_protocols:
        ours = first.protocol.content
        theirs = second.protocol.content
        unequal = sorted(k for k in {*ours, *theirs} if ours.get(k) != theirs.get(k))
        raise ValueError(
            f"{first.name} was judged by {first.protocol}, {second.name} by {second.protocol}, "
            f"which differ in {', '.join(unequal)}: evaluate both by one protocol, or add "
            "--across-protocols to compare them all the same"
        )
    shared = [name for name in first.scenes if name in second.scenes]
    if not shared:
        raise ValueError(f"{first.name} and {second.name} have no scene in common")
    # Protocols that draw views name no frames: the data decides.
    every = [*first.trainings, *second.trainings]
    moved = [name for name in shared if len({run.frames[name] for run in every}) > 1]
    if moved and not across_protocols:
        raise ValueError(
            f"{first.name} and {second.name} judged {len(moved)} scenes on different frames, "
            f"although their protocols agree: {listed(moved)}. The data, or how views are "
            "drawn, changed between them: evaluate both again, or add --across-protocols"
        )
    pairs = paired_trainings(first, second)
    differences = []
    for metric in first.columns:
        scenes = scenes_with(metric, [run for pair in pairs for run in pair])
        if metric in second.columns and scenes:
            differences.append(_difference(metric, first.columns[metric], pairs, scenes))
    return Comparison(
        first=first,
        second=second,
        shared=shared,
        moved=moved,
        pairs=pairs,
        differences=differences,
    )


def _difference(metric: str, column: Column, pairs: Pairs, scenes: Sequence[str]) -> Difference:
    first = np.array([ours.scores(metric, scenes) for ours, _ in pairs])
    second = np.array([theirs.scores(metric, scenes) for _, theirs in pairs])
    apart = first - second
    # By scene: of several trainings their mean.
    better = apart.mean(0) if column.better == "higher" else -apart.mean(0)
    low, high = interval(apart)
    return Difference(
        metric=metric,
        column=column,
        scenes=len(scenes),
        trainings=len(pairs),
        first=float(first.mean()),
        second=float(second.mean()),
        difference=float(apart.mean()),
        low=low,
        high=high,
        wins=int((better > 0).sum()),
        losses=int((better < 0).sum()),
    )


def grouped(results: Sequence[StoredResults]) -> Sequence[StoredResults]:
    """Trainings of one recipe with several seeds as one result, where there are others too.

    Its values are means over its `runs`, of the scenes that all of them judged.
    """
    groups: dict[Any, list[StoredResults]] = {}
    for number, result in enumerate(results):
        # Results without a run folder have no recipe: each is a side of its own.
        key = (result.recipe, result.protocol.sha256) if result.recipe else number
        groups.setdefault(key, []).append(result)
    # Alone, the seeds of one recipe are what is compared.
    if len(groups) < 2:
        return results
    sides: list[StoredResults] = []
    for runs in groups.values():
        # A seed twice is no second training.
        several = len({run.seed for run in runs}) == len(runs) > 1
        sides += [_mean(runs)] if several else runs
    # Sides whose runs lie in one folder have all of their runs as a name.
    names = [side.name for side in sides]
    return [
        replace(side, name=", ".join(run.name for run in side.trainings))
        if names.count(side.name) > 1
        else side
        for side in sides
    ]


def _mean(runs: Sequence[StoredResults]) -> StoredResults:
    first = runs[0]
    scenes: dict[str, dict[str, float]] = {}
    for scene, values in first.scenes.items():
        every = [run.scenes[scene] for run in runs if scene in run.scenes]
        if len(every) == len(runs):
            keys = [key for key in values if all(key in one for one in every)]
            scenes[scene] = {key: float(np.mean([one[key] for one in every])) for key in keys}
    names = [run.name for run in runs]
    # Absolute and relative paths have no common folder.
    folder = os.path.commonpath(names) if len({*map(os.path.isabs, names)}) == 1 else ""
    return replace(first, name=folder or ", ".join(names), scenes=scenes, runs=tuple(runs))


def paired_trainings(first: StoredResults, second: StoredResults) -> Pairs:
    """Pairs of equal seeds, else in their order; the means where a side has a single training."""
    ours = {run.seed: run for run in first.runs}
    theirs = {run.seed: run for run in second.runs}
    # Equal seeds saw the same data in the same order.
    if len(common := [seed for seed in ours if seed in theirs]) > 1:
        return [(ours[seed], theirs[seed]) for seed in common]
    if min(len(ours), len(theirs)) > 1:
        return [*zip(ours.values(), theirs.values(), strict=False)]
    return [(first, second)]
