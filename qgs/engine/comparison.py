"""Two evaluations, scene by scene: mean differences, their uncertainty, wins and losses."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from qgs.engine.results import StoredResults, listed, markdown_table
from qgs.io.files import write_text

RESAMPLES = 10_000
CONFIDENCE = 0.95
_SEED = 0
_AT_A_TIME = 1_000_000

COLUMNS = {
    "model_psnr": ("PSNR ↑", 1, 3),
    "model_ssim": ("SSIM ↑", 1, 4),
    "model_lpips": ("LPIPS ↓", -1, 4),
    "dispersion_mean": ("dispersion mean ↓", -1, 4),
    "dispersion_median": ("dispersion med. ↓", -1, 4),
}
"""Compared values of a scene: header, sign of better, digits."""


@dataclass(frozen=True)
class Difference:
    """One metric over the scenes that both results have; differences are first minus second.

    low, high: the 95 % interval of the mean difference over scenes, None for fewer than two.
    wins, losses: scenes in which the first is better, or worse; the rest are equal.
    """

    metric: str
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
    """The first results against others. wanted: how many scenes their protocols name.

    missing_first, missing_second: scenes without a score. null: scenes that an index lists without
    frames. only_first, only_second: scenes that one alone judged. empty: metrics that one of them
    lacks. other_frames: shared scenes judged on different frames.
    """

    first: str
    second: str
    same_protocol: bool
    other_frames: Sequence[str]
    differences: Sequence[Difference]
    wanted: int
    missing_first: Sequence[str]
    missing_second: Sequence[str]
    null: Sequence[str]
    only_first: Sequence[str]
    only_second: Sequence[str]
    empty: Sequence[str]


@dataclass(frozen=True)
class Comparisons:
    """Results against each of others. protocols: result to the name and hash of its protocol."""

    protocols: Mapping[str, str]
    pairs: Sequence[Comparison]

    @classmethod
    def of(cls, results: Sequence[StoredResults], across_protocols: bool = False) -> Self:
        """Compare the first of `results` with each of the others.

        Raises ValueError for fewer than two, for one folder twice, for results without a scene in
        common, and unless `across_protocols` for results of different protocols and for scenes that
        were judged on different frames.
        """
        names = [result.name for result in results]
        if len(names) < 2 or len(set(names)) < len(names):
            raise ValueError(f"a comparison takes two or more different results, got {names}")
        first, *others = results
        for other in others:
            if other.sha256 != first.sha256 and not across_protocols:
                raise ValueError(_different_protocols(first, other))
            moved = _judged_on_other_frames(first, other)
            if moved and not across_protocols:
                raise ValueError(_different_frames(first, other, moved))
        protocols = {result.name: _protocol(result) for result in results}
        return cls(protocols, [_compared(first, other) for other in others])

    def show(self, console: Console) -> None:
        """Print a table for each pair."""
        for pair in self.pairs:
            table = Table(
                title=escape(_title(pair)),
                title_justify="left",
                box=box.SIMPLE_HEAD,
                collapse_padding=True,
                pad_edge=False,
            )
            header, *rows = _rows(pair)
            for name in header:
                table.add_column(
                    name, no_wrap=True, justify="left" if name == header[0] else "right"
                )
            for row in rows:
                table.add_row(*row)
            console.print(table)
            for line in _notes(pair):
                console.print(escape(line), highlight=False, soft_wrap=True)
        for line in self._protocol_lines():
            console.print(escape(line), highlight=False, soft_wrap=True)

    def write(self, folder: Path) -> None:
        """Write comparison.json and comparison.md into `folder`."""
        record = {
            "protocols": dict(self.protocols),
            "bootstrap": {"resamples": RESAMPLES, "confidence": CONFIDENCE, "seed": _SEED},
            "pairs": [asdict(pair) for pair in self.pairs],
        }
        text = json.dumps(record, indent=2, ensure_ascii=False, allow_nan=False)
        write_text(folder / "comparison.json", text + "\n")
        write_text(folder / "comparison.md", self.markdown())

    def markdown(self) -> str:
        """The tables and what is to be known beside them."""
        parts = []
        for pair in self.pairs:
            notes = "\n".join(f"- {line}" for line in _notes(pair))
            parts += [f"**{_title(pair)}**", markdown_table(_rows(pair)), notes]
        parts.append("\n".join(f"- {line}" for line in self._protocol_lines()))
        return "\n\n".join(parts) + "\n"

    def _protocol_lines(self) -> list[str]:
        if len(set(self.protocols.values())) == 1:
            return [f"protocol {next(iter(self.protocols.values()))}"]
        return [f"protocol of {name}: {protocol}" for name, protocol in self.protocols.items()]


def paired_interval(differences: np.ndarray) -> tuple[float, float] | None:
    """Percentile bootstrap interval of the mean of differences (S,), one per scene.

    The same for the same numbers: the resamples are seeded. None for fewer than two scenes.
    """
    count = len(differences)
    if count < 2:
        return None
    rng = np.random.default_rng(_SEED)
    step = max(_AT_A_TIME // count, 1)
    means = np.concatenate(
        [
            differences[rng.integers(0, count, (min(step, RESAMPLES - start), count))].mean(1)
            for start in range(0, RESAMPLES, step)
        ]
    )
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)


def _compared(first: StoredResults, second: StoredResults) -> Comparison:
    shared = [name for name in first.scenes if name in second.scenes]
    if not shared:
        raise ValueError(f"{first.name} and {second.name} have no scene in common")
    ours, theirs = first.scenes[shared[0]], second.scenes[shared[0]]
    return Comparison(
        first=first.name,
        second=second.name,
        same_protocol=first.sha256 == second.sha256,
        other_frames=_judged_on_other_frames(first, second),
        differences=[
            _difference(
                metric,
                np.array([first.scenes[name][metric] for name in shared]),
                np.array([second.scenes[name][metric] for name in shared]),
            )
            for metric in COLUMNS
            if metric in ours and metric in theirs
        ],
        wanted=max(first.wanted, second.wanted),
        missing_first=first.missing,
        missing_second=second.missing,
        null=list(dict.fromkeys([*first.null, *second.null])),
        only_first=[name for name in first.scenes if name not in second.scenes],
        only_second=[name for name in second.scenes if name not in first.scenes],
        empty=[m for m in COLUMNS if m not in ours or m not in theirs],
    )


def _judged_on_other_frames(first: StoredResults, second: StoredResults) -> list[str]:
    shared = [name for name in first.frames if name in second.frames]
    return [name for name in shared if first.frames[name] != second.frames[name]]


def _difference(metric: str, first: np.ndarray, second: np.ndarray) -> Difference:
    apart = first - second
    better = apart * COLUMNS[metric][1]
    low, high = paired_interval(apart) or (None, None)
    return Difference(
        metric=metric,
        scenes=len(apart),
        first=float(first.mean()),
        second=float(second.mean()),
        difference=float(apart.mean()),
        low=low,
        high=high,
        wins=int((better > 0).sum()),
        losses=int((better < 0).sum()),
    )


def _title(pair: Comparison) -> str:
    count = pair.differences[0].scenes
    scenes = f"{count} scene{'s' if count > 1 else ''}"
    if count < pair.wanted:
        missing = list(dict.fromkeys([*pair.missing_first, *pair.missing_second]))
        names = f" (missing: {listed(missing)})" if missing else ""
        scenes = f"{count} of {pair.wanted} scenes{names}"
    return f"{pair.first} against {pair.second}, {scenes}"


def _rows(pair: Comparison) -> list[list[str]]:
    percent = f"{100 * CONFIDENCE:.0f} % interval"
    rows = [["metric", "first", "second", "difference", percent, "won : lost"]]
    for d in pair.differences:
        header, _, digits = COLUMNS[d.metric]
        interval = "–"
        if d.low is not None and d.high is not None:
            interval = f"[{d.low:+.{digits}f}, {d.high:+.{digits}f}]"
        numbers = f"{d.first:.{digits}f}", f"{d.second:.{digits}f}", f"{d.difference:+.{digits}f}"
        rows.append([header, *numbers, interval, f"{d.wins} : {d.losses}"])
    return rows


def _notes(pair: Comparison) -> list[str]:
    lines = [
        f"difference: {pair.first} minus {pair.second}, mean over scenes; interval: percentile "
        f"bootstrap over scenes, {RESAMPLES:,} resamples"
    ]
    if pair.differences[0].low is None:
        lines.append("one scene is too few for an interval")
    for name, scenes in ((pair.first, pair.missing_first), (pair.second, pair.missing_second)):
        if scenes:
            lines.append(f"{name} is incomplete: no score of {listed(scenes)}")
    if pair.null:
        lines.append(
            f"null entries of the index, not judged ({len(pair.null)}): {listed(pair.null)}"
        )
    for name, scenes in ((pair.first, pair.only_first), (pair.second, pair.only_second)):
        if scenes:
            lines.append(f"{len(scenes)} scenes only in {name}, left out: {listed(scenes)}")
    if pair.empty:
        empty = ", ".join(COLUMNS[metric][0].split(" ↓")[0].split(" ↑")[0] for metric in pair.empty)
        lines.append(f"not in both, left out: {empty}")
    if not pair.same_protocol:
        lines.append("the protocols differ: the scores do not measure the same")
    if pair.other_frames:
        lines.append(
            f"{len(pair.other_frames)} scenes judged on different frames: "
            f"{listed(pair.other_frames)}"
        )
    return lines


def _protocol(result: StoredResults) -> str:
    text = f"{result.protocol_name}, sha256 {result.sha256}"
    covariance = result.protocol.get("ssim_covariance", "population")
    return text if covariance == "population" else f"{text}, SSIM with {covariance} covariance"


def _different_protocols(first: StoredResults, other: StoredResults) -> str:
    keys = sorted({*first.protocol, *other.protocol})
    unequal = [key for key in keys if first.protocol.get(key) != other.protocol.get(key)]
    return (
        f"{first.name} was judged by {first.protocol_name} ({first.sha256[:12]}), {other.name} by "
        f"{other.protocol_name} ({other.sha256[:12]}), which differ in {', '.join(unequal)}: "
        "evaluate both alike, or add --across-protocols to compare them all the same"
    )


def _different_frames(first: StoredResults, other: StoredResults, moved: Sequence[str]) -> str:
    return (
        f"{first.name} and {other.name} judged {len(moved)} scenes on different frames, although "
        f"their protocols agree: {listed(moved)}. The data, or how views are drawn, changed "
        "between them: evaluate both again, or add --across-protocols"
    )
