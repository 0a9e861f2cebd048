"""Scores of an evaluation: by scene, their means, files and tables."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from qgs.data.evaluation import GIVEN, SceneFailure, given_targets
from qgs.data.sampling import Frames
from qgs.engine.protocol import Protocol
from qgs.io.files import write_text
from qgs.metrics import OPACITY_USED, spread

DISPERSIONS = ("dispersion_mean", "dispersion_median")
"""Over a scene's Gaussians, of the distance to their token's centroid, world units."""

TUNING: tuple[str, str] = ("tuning_loss_before", "tuning_loss_after")


def column(method: str, metric: str) -> str:
    """What one of METRICS of one of METHODS is called in `SceneScore.values`."""
    return f"{method}_{metric}"


@dataclass(frozen=True)
class SceneScore:
    """One scene. views: input and target frames of each of its samples.

    values: image metrics by `column`, means over the target views of a sample, then over samples;
    DISPERSIONS; "gaussians_used"; of tuned scenes TUNING.
    """

    scene: str
    views: Sequence[tuple[Frames, Frames]]
    values: Mapping[str, float]

    @property
    def given(self) -> tuple[int, ...]:
        """Frames that one of the samples has as input and as target."""
        both = [given_targets(*frames) for frames in self.views]
        return tuple(sorted({frame for frames in both for frame in frames}))


@dataclass(frozen=True)
class Evaluation:
    """All scenes and what they amount to; the same weights and recipe give the same numbers.

    scores: of the scenes that were judged. wanted: names of all that the protocol names. missing:
    those without a score. null: scenes that the index lists without frames. unlisted: scenes of the
    data that the index lacks. gaussians: how many a scene has. empty: metrics that could not be
    computed, and why. held_out: how many held-out frames were judged, and how many there are; None
    where the test scenes hold none out. step: optimiser steps behind the weights.
    """

    protocol: Protocol
    scores: Sequence[SceneScore]
    wanted: Sequence[str]
    gaussians: int
    missing: Sequence[SceneFailure] = ()
    null: Sequence[str] = ()
    unlisted: Sequence[str] = ()
    empty: Mapping[str, str] = field(default_factory=dict)
    held_out: tuple[int, int] | None = None
    step: int | None = None

    def mean(self, metric: str, method: str = "model") -> float | None:
        """Mean over the judged scenes of one of METRICS of one of METHODS; None if it is empty.

        Scenes weigh alike, however many samples and views they have.
        """
        return None if metric in self.empty else self.mean_value(column(method, metric))

    def mean_value(self, name: str) -> float:
        """Mean over the judged scenes of one of `SceneScore.values`."""
        return sum(score.values[name] for score in self.scores) / len(self.scores)

    @property
    def is_complete(self) -> bool:
        """Whether every scene that the protocol names has a score."""
        return not self.missing

    def summary(self) -> dict[str, Any]:
        """Everything but the scores of single scenes, as plain values for JSON.

        Dispersion and used Gaussians: mean, variance and median over scenes.
        """
        return {
            "protocol": {
                "name": self.protocol.name,
                "sha256": self.protocol.sha256,
                "settings": self.protocol.settings(),
            },
            "step": self.step,
            "statement": statement(self),
            "scenes": len(self.scores),
            "scenes_in_protocol": len(self.wanted),
            "samples": sum(len(score.views) for score in self.scores),
            "missing": {failure.scene: failure.reason for failure in self.missing},
            "null_entries": list(self.null),
            "not_in_index": list(self.unlisted),
            "context_and_target": {s.scene: list(s.given) for s in self.scores if s.given},
            **{method: {m: self.mean(m, method) for m in METRICS} for method in METHODS},
            "empty": dict(self.empty),
            "dispersion_over_gaussians": {
                name.removeprefix("dispersion_"): self._spread(name) for name in DISPERSIONS
            },
            "gaussians": self.gaussians,
            "gaussians_used": {"opacity_above": OPACITY_USED, **self._spread("gaussians_used")},
            "tuning": self._tuning(),
            "held_out_frames": self.held_out,
        }

    def write(self, folder: str | Path) -> None:
        """Write scenes.csv, summary.json, table.md and protocol.json, each whole or not at all.

        protocol.json is `Protocol.canonical`: its SHA-256 is the protocol's hash.
        """
        write(self, Path(folder))

    def show(self, console: Console) -> None:
        """Print the table that a person compares by, and what is to be known beside it."""
        show(self, console)

    def _spread(self, name: str) -> dict[str, float]:
        values = torch.tensor([score.values[name] for score in self.scores], dtype=torch.float64)
        return asdict(spread(values))

    def _tuning(self) -> dict[str, Any] | None:
        settings = self.protocol.content["tuning"]
        if settings is None:
            return None
        before, after = (self.mean_value(name) for name in TUNING)
        return {**settings, "loss_before": before, "loss_after": after}


METHODS = ("model", "nearest_input", "mean_colour")
HEADERS = {"psnr": "PSNR ↑", "ssim": "SSIM ↑", "lpips": "LPIPS ↓"}
METRICS = tuple(HEADERS)
DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}
EMPTY = "–"
_NAMED = 10


def write(evaluation: Evaluation, folder: Path) -> None:
    """See `Evaluation.write`."""
    summary = json.dumps(evaluation.summary(), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(folder / "scenes.csv", scenes_csv(evaluation))
    write_text(folder / "summary.json", summary + "\n")
    write_text(folder / "table.md", markdown(evaluation))
    write_text(folder / "protocol.json", evaluation.protocol.canonical)


def show(evaluation: Evaluation, console: Console) -> None:
    """See `Evaluation.show`."""
    table = Table(title=escape(str(evaluation.protocol)), title_justify="left")
    header, *rows = score_rows(evaluation)
    for name in header:
        table.add_column(name, justify="left" if name == "method" else "right")
    for row in rows:
        table.add_row(*row)
    console.print(table)
    for line in (*notes(evaluation), _about_dispersion(evaluation)):
        console.print(escape(line), highlight=False, soft_wrap=True)


def statement(evaluation: Evaluation) -> str:
    """The model's PSNR and over how many scenes, in one line."""
    scenes = "scene" if len(evaluation.wanted) == 1 else "scenes"
    line = f"PSNR {_number(evaluation, 'psnr', 'model')} over {coverage(evaluation)} {scenes}"
    missing = [failure.scene for failure in evaluation.missing]
    return f"{line}; missing: {listed(missing)}" if missing else line


def coverage(evaluation: Evaluation) -> str:
    """How many scenes have a score, "138 of 140" where some lack it."""
    judged, wanted = len(evaluation.scores), len(evaluation.wanted)
    return str(judged) if evaluation.is_complete else f"{judged} of {wanted}"


def score_rows(evaluation: Evaluation) -> list[list[str]]:
    """The table, headers first: a row per method, in it how many scenes it is over."""
    header = ["method", *HEADERS.values(), "scenes"]
    covariance = evaluation.protocol.content["ssim_covariance"]
    if covariance != "population":
        header[header.index(HEADERS["ssim"])] = f"SSIM ({covariance} covariance) ↑"
    rows = [
        [
            method.replace("_", " "),
            *(_number(evaluation, metric, method) for metric in HEADERS),
            coverage(evaluation),
        ]
        for method in METHODS
    ]
    return [header, *rows]


def markdown(evaluation: Evaluation) -> str:
    """The table in Markdown, token dispersion as published, and the notes."""
    spreads = evaluation.summary()["dispersion_over_gaussians"]
    dispersion = [["token dispersion, world units", "mean", "variance", "median", "scenes"]]
    for name, values in spreads.items():
        cells = [f"{values[key]:.4f}" for key in ("mean", "variance", "median")]
        dispersion.append([f"{name} over Gaussians", *cells, coverage(evaluation)])
    sections = [
        markdown_table(score_rows(evaluation)),
        markdown_table(dispersion),
        "\n".join(f"- {line}" for line in notes(evaluation)),
    ]
    return "\n\n".join(sections) + "\n"


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of equal length, headers first, as a Markdown table; numbers to the right."""
    cells = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "| "
        + " | ".join(
            cell.rjust(width) if place else cell.ljust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        + " |"
        for row in cells
    ]
    rule = "|:" + "-" * (widths[0] + 1) + "".join(f"|{'-' * (width + 1)}:" for width in widths[1:])
    return "\n".join([lines[0], rule + "|", *lines[1:]])


def notes(evaluation: Evaluation) -> list[str]:
    """What is to be known beside the table, one line each."""
    lines = [statement(evaluation), _about_protocol(evaluation)]
    lines += [f"missing {f.scene}: {f.reason}" for f in evaluation.missing[:_NAMED]]
    if len(evaluation.missing) > _NAMED:
        lines.append(f"{len(evaluation.missing) - _NAMED} more missing scenes are in scenes.csv")
    for names, what in (
        (evaluation.null, "null entries of the index"),
        (evaluation.unlisted, "scenes of the data that the index lacks"),
    ):
        if names:
            lines.append(f"{what}, not judged ({len(names)}): {listed(names)}")
    lines += _about_given(evaluation)
    lines += [f"{HEADERS[m].split()[0]} is empty: {why}" for m, why in evaluation.empty.items()]
    if evaluation.held_out:
        lines.append("judged on {} of {} held-out frames".format(*evaluation.held_out))
    return [*lines, *_about_gaussians(evaluation), *_about_tuning(evaluation)]


def listed(names: Sequence[str], most: int = _NAMED) -> str:
    """Names with commas between, at most so many."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def scenes_csv(evaluation: Evaluation) -> str:
    """A line per scene that the protocol names, in its order; those without a score say why."""
    judged = {score.scene: score for score in evaluation.scores}
    reasons = {failure.scene: failure.reason for failure in evaluation.missing}
    columns = list(next(iter(judged.values())).values)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["scene", "input_frames", "target_frames", *columns, "problem"])
    for name in evaluation.wanted:
        if name in judged:
            writer.writerow([name, *_frames(judged[name]), *judged[name].values.values(), ""])
        else:
            writer.writerow([name, "", "", *("" for _ in columns), reasons[name]])
    return text.getvalue()


def _number(evaluation: Evaluation, metric: str, method: str) -> str:
    value = evaluation.mean(metric, method)
    return EMPTY if value is None else f"{value:.{DIGITS[metric]}f}"


def _about_given(evaluation: Evaluation) -> Iterable[str]:
    given = {score.scene: score.given for score in evaluation.scores if score.given}
    if given:
        named = [f"{scene} ({' '.join(map(str, frames))})" for scene, frames in given.items()]
        yield (
            f"{len(given)} scene{'s' if len(given) > 1 else ''} with {GIVEN}, on which the nearest "
            f"input view is perfect: {listed(named)}"
        )


def _about_gaussians(evaluation: Evaluation) -> Iterable[str]:
    summary = evaluation.summary()
    used = summary["gaussians_used"]
    yield (
        f"{evaluation.gaussians:,} Gaussians a scene, {used['mean']:,.0f} of them used (opacity "
        f"above {OPACITY_USED:.4f}; mean over scenes, median {used['median']:,.0f})"
    )


def _about_dispersion(evaluation: Evaluation) -> str:
    dispersion = evaluation.summary()["dispersion_over_gaussians"]
    return (
        "token dispersion, mean over Gaussians: mean {mean:.4f}, variance {variance:.4f}, median "
        "{median:.4f} over scenes; ".format(**dispersion["mean"])
        + "median over Gaussians: mean {mean:.4f}".format(**dispersion["median"])
    )


def _about_protocol(evaluation: Evaluation) -> str:
    protocol, content = evaluation.protocol, evaluation.protocol.content
    height, width = content["image_size"]
    poses = content["poses"]
    counts = sorted({len(inputs) for score in evaluation.scores for inputs, _ in score.views})
    return (
        f"protocol {protocol.name}, sha256 {protocol.sha256}: {' or '.join(map(str, counts))} "
        f"input views of {width} x {height} pixels, poses {poses['frame']}, scale "
        f"{poses['scale']} {poses['scale_factor']}"
    )


def _about_tuning(evaluation: Evaluation) -> Iterable[str]:
    tuning = evaluation.summary()["tuning"]
    if tuning:
        yield (
            f"tokens tuned on the input views: {tuning['steps']} steps of Adam at {tuning['rate']},"
            f" photometric loss {tuning['loss_before']:.4f} -> {tuning['loss_after']:.4f}"
        )


def _frames(score: SceneScore) -> list[str]:
    """Input and target frames; those of several samples with semicolons between."""
    return ["; ".join(" ".join(map(str, frames)) for frames in side) for side in _sides(score)]


def _sides(score: SceneScore) -> Iterable[Iterable[Frames]]:
    return zip(*score.views, strict=True)


@dataclass(frozen=True)
class StoredResults:
    """Results of one evaluation. name: the folder, as it was given. protocol: its content.

    scenes: name to values as `SceneScore.values`, of the scenes that were judged. frames: their
    input and target frames, as scenes.csv writes them. wanted: how many scenes the protocol names.
    missing: those without a score. null: scenes that the index lists without frames.
    """

    name: str
    protocol_name: str
    sha256: str
    protocol: Mapping[str, Any]
    scenes: Mapping[str, Mapping[str, float]]
    frames: Mapping[str, tuple[str, str]]
    wanted: int
    missing: Sequence[str] = ()
    null: Sequence[str] = ()


def read_results(path: str | Path) -> StoredResults:
    """Results in `path`: a folder that `qgs eval` wrote, or a run folder whose evaluation/ it is.

    Raises FileNotFoundError when there are none, ValueError when they cannot be read.
    """
    folder = Path(path)
    if not (folder / "summary.json").is_file():
        folder = folder / "evaluation"
    if not (folder / "summary.json").is_file():
        raise FileNotFoundError(
            f"no results in {path}; give a folder that `qgs eval` wrote, or a run folder with an "
            "evaluation/ in it"
        )
    try:
        return _read(folder, str(path))
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise ValueError(
            f"the results in {folder} cannot be read ({type(error).__name__}: {error}): they were "
            "changed, or written by an earlier version; evaluate again with `qgs eval`"
        ) from error


def _read(folder: Path, name: str) -> StoredResults:
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    protocol = json.loads((folder / "protocol.json").read_text(encoding="utf-8"))
    with (folder / "scenes.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    told = {"scene", "input_frames", "target_frames", "problem"}
    judged = {row["scene"]: row for row in rows if not row["problem"]}
    scenes = {
        scene: {key: float(value) for key, value in row.items() if key not in told}
        for scene, row in judged.items()
    }
    frames = {s: (row["input_frames"], row["target_frames"]) for s, row in judged.items()}
    stated = summary["protocol"]
    return StoredResults(
        name=name,
        protocol_name=stated["name"],
        sha256=stated["sha256"],
        protocol=protocol,
        scenes=scenes,
        frames=frames,
        wanted=summary["scenes_in_protocol"],
        missing=list(summary["missing"]),
        null=summary["null_entries"],
    )
