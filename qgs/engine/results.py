"""The files and the table of an evaluation."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from qgs.data.index import GIVEN
from qgs.io.atomic import write_text
from qgs.metrics import OPACITY_USED

if TYPE_CHECKING:
    from qgs.data.sampling import Frames
    from qgs.engine.scores import Evaluation, SceneScore

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
