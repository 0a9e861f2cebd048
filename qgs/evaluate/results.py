"""Results of an evaluation: scores of scenes, their means, and the files and tables of both."""

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, median, pvariance
from typing import Any

from rich.box import MARKDOWN
from rich.console import Console

from qgs.contracts import Column, Window
from qgs.evaluate.protocol import Protocol
from qgs.files import write_text
from qgs.metrics.baselines import BASELINES
from qgs.metrics.dispersion import OPACITY_USED
from qgs.terminal import print_lines, print_table
from qgs.wording import counted, listed

METHODS = ("model", *BASELINES)


@dataclass(frozen=True)
class SceneScore:
    """Scores of one scene.

    views: input and target frames of each sample. values: means over the samples by name, which is
        "gaussians_used" or METHOD_METRIC, such as "model_psnr". A value is absent if the method or
        the scene lacks an input of the metric. names: names of photos by frame number.
    """

    scene: str
    views: Sequence[Window]
    values: Mapping[str, float]
    names: Mapping[int, str]

    @property
    def given(self) -> list[int]:
        """Frames that are both input and target of one sample.

        Their scores mean nothing, because the model has seen the target.
        """
        both = [{*inputs}.intersection(targets) for inputs, targets in self.views]
        return sorted(set().union(*both))


@dataclass(frozen=True)
class Evaluation:
    """Scores of all scenes and their means. The same weights and recipe give the same numbers.

    columns: display of each value in tables, by name of the value. scores: scores of the scenes.
    gaussians: largest number of Gaussians of a scene. missing: scenes of the protocol without a
        score, each with the reason. incomplete: values that some scenes lack, by name, each with
        the reason.
    step: number of optimiser steps after which the weights were saved; None if unknown. remarks:
        sentences on the views and on the scores.
    """

    protocol: Protocol
    columns: Mapping[str, Column]
    scores: Sequence[SceneScore]
    gaussians: int
    missing: Mapping[str, str]
    incomplete: Mapping[str, str]
    step: int | None
    remarks: Sequence[str] = ()

    @property
    def samples(self) -> int:
        """Number of samples in all scenes."""
        return sum(len(score.views) for score in self.scores)

    def mean(self, value: str) -> float | None:
        """Return the mean of a value over the scenes that have it; None if no scene has it.

        value: name of the value, "gaussians_used" or METHOD_METRIC such as "model_psnr".
        """
        found = self._values(value)
        return fmean(found) if found else None

    def means(self, method: str = "model") -> dict[str, float | None]:
        """Return the mean over scenes of each value in `columns`, by name.

        method: "model" or the name of a baseline.
        """
        return {name: self.mean(f"{method}_{name}") for name in self.columns}

    def summary(self) -> dict[str, Any]:
        """Return all results except the scores of single scenes, as plain values for JSON.

        The entry "over_scenes" has mean, population variance and median of the model's values.
        """
        values = {name: self._values(f"model_{name}") for name in self.columns}
        return {
            "protocol": {"name": self.protocol.name, "sha256": self.protocol.sha256},
            "step": self.step,
            "scenes": len(self.scores),
            "scenes_in_protocol": self._wanted,
            "samples": self.samples,
            "missing": self.missing,
            "context_and_target": {s.scene: s.given for s in self.scores if s.given},
            "columns": {name: asdict(column) for name, column in self.columns.items()},
            **{method: self.means(method) for method in METHODS},
            "incomplete": self.incomplete,
            "over_scenes": {
                name: {
                    "mean": fmean(found),
                    "variance": pvariance(found),
                    "median": median(found),
                    "scenes": len(found),
                }
                for name, found in values.items()
                if found
            },
            "gaussians": self.gaussians,
            "gaussians_used": {"opacity_above": OPACITY_USED, "mean": self.mean("gaussians_used")},
            "tuning": self.protocol.content["tuning"],
            "remarks": self.remarks,
        }

    def write(self, folder: str | Path) -> None:
        """Write scenes.csv, summary.json, table.md and protocol.json, each atomically.

        protocol.json holds `Protocol.canonical`; the SHA-256 of this file is the protocol's hash.
        """
        table = io.StringIO()
        # As wide as the lines are; without the colours that the environment may ask for.
        plain = Console(
            file=table, width=10_000, color_system=None, force_terminal=False, emoji=False
        )
        self.show(plain)
        files = {
            "scenes.csv": self._csv(),
            "summary.json": as_json(self.summary()),
            "table.md": table.getvalue(),
            # Last: `qgs train --resume` takes it as the sign of a whole evaluation.
            "protocol.json": self.protocol.canonical,
        }
        for name, text in files.items():
            write_text(Path(folder, name), text)

    def show(self, console: Console) -> None:
        """Print the table of means and the notes below it as Markdown."""
        print_table(console, self.protocol.name, self._rows(), box=MARKDOWN)
        print_lines(console, (f"- {note}" for note in self._notes()))

    def _values(self, name: str) -> list[float]:
        return [score.values[name] for score in self.scores if name in score.values]

    @property
    def _wanted(self) -> int:
        return len(self.scores) + len(self.missing)

    def _rows(self) -> list[list[str]]:
        """Return the rows of the table; each has a method's means and the number of scenes."""
        judged = f"{len(self.scores)} of {self._wanted}" if self.missing else str(self._wanted)
        rows = [["method", *(column.title for column in self.columns.values()), "scenes"]]
        for method in METHODS:
            cells = [self.columns[name].shown(v) for name, v in self.means(method).items()]
            rows.append([method.replace("_", " "), *cells, judged])
        return rows

    def _csv(self) -> str:
        rows: list[dict[str, Any]] = []
        columns: dict[str, Any] = {}
        for score in self.scores:
            row: dict[str, Any] = {"scene": score.scene}
            for place, column in enumerate(("input_frames", "target_frames")):
                samples = []
                for views in score.views:
                    # By name where they have any.
                    names = [score.names.get(frame, str(frame)) for frame in views[place]]
                    samples.append(" ".join(names))
                row[column] = "; ".join(samples)
            row |= score.values
            rows.append(row)
            # A column stays where the first scene that has it puts it.
            columns |= row
        # A scene that is missing has a row too, so that it shows in the file.
        rows += [{"scene": scene, "problem": reason} for scene, reason in self.missing.items()]
        text = io.StringIO()
        writer = csv.DictWriter(text, [*columns, "problem"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return text.getvalue()

    def _notes(self) -> Iterator[str]:
        """Yield notes to print below the table, such as missing scores and the protocol."""
        content = self.protocol.content
        height, width = content["image_size"]
        counts = {len(inputs) for score in self.scores for inputs, _ in score.views}
        poses = content["poses"]
        scale = f"{poses['scale']} {poses.get('scale_factor', '')}".rstrip()
        yield (
            f"protocol {self.protocol.name}, sha256 {self.protocol.sha256}: "
            f"{' or '.join(map(str, sorted(counts)))} input views of {width} x {height} pixels, "
            f"poses {poses['frame']}, scale {scale}"
        )
        # A broken data set would bury the table; scenes.csv has every reason.
        yield from (f"missing {scene}: {why}" for scene, why in [*self.missing.items()][:10])
        if given := [score.scene for score in self.scores if score.given]:
            yield (
                f"{counted(len(given), 'scene')} with frames as input and as target, for "
                f"which the nearest input view is perfect: {listed(given)}"
            )
        for name, why in self.incomplete.items():
            yield f"{self.columns[name].heading} is not complete: {why}"
        used = self.mean("gaussians_used")
        yield (
            f"at most {self.gaussians:,} Gaussians per scene, {used:,.0f} of them used (opacity > "
            f"{OPACITY_USED:.4f}; mean over scenes)"
        )
        if tuning := content["tuning"]:
            yield "{what} tuned on the inputs: {steps} Adam steps, learning rate {rate}".format_map(
                tuning
            )
        yield from self.remarks


def as_json(value: Mapping[str, Any]) -> str:
    """Return indented JSON text that ends with a newline; raise ValueError for NaN and infinity."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
