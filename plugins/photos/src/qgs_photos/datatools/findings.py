"""Hold and print the findings of a check: one line for each fault, one row for each scene."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from typing import Any, Literal

from qgs.wording import listed

Severity = Literal["error", "warning"]

_FEW = 3
_ROWS = 40


@dataclass(frozen=True)
class Finding:
    """A fault of a scene or a file, and how to correct it.

    scene: name of the scene or of the file. reason: what is wrong. fix: what to do. photos: the
    faulty photos, each with its index in the list of photos, its file name, and its frame number in
    the loaded scene, which is None for a photo that is not loaded; empty if the whole scene is at
    fault. severity: an error makes results wrong; a warning marks what may make results wrong.
    """

    scene: str
    reason: str
    fix: str
    severity: Severity = "error"
    photos: tuple[tuple[int, str, int | None], ...] = ()

    @property
    def place(self) -> str:
        """Text that names the photos, such as "frames 0-3 (a.jpg to d.jpg)"; "" without photos."""
        names = [name for _, name, _ in self.photos if name]
        numbers = [number for *_, number in self.photos if number is not None]
        if not numbers:
            return listed(names, 3)
        text = f"frame{'s' if len(numbers) > 1 else ''} {spans(numbers)}"
        if not names:
            return text
        last = f" to {names[-1]}" if len(names) > 1 else ""
        return f"{text} ({names[0]}{last})"

    def __str__(self) -> str:
        where = ", ".join(filter(None, [self.scene, self.place]))
        return " ".join(f"{self.severity}: {where}: {self.reason}: {self.fix}".split())


def errors_of(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings that are errors, without warnings."""
    return [finding for finding in findings if finding.severity == "error"]


def spans(numbers: Iterable[int]) -> str:
    """Return numbers as text, with consecutive numbers joined, such as "0-3, 7".

    After eight runs of consecutive numbers, the text only counts the further runs.
    """
    # numbers of one run are all equally far ahead of their places
    grouped = groupby(enumerate(sorted(set(numbers))), lambda item: item[1] - item[0])
    runs = [[number for _, number in run] for _, run in grouped]
    return listed(f"{run[0]}-{run[-1]}" if len(run) > 1 else run[0] for run in runs)


def merged(findings: Sequence[Finding]) -> list[Finding]:
    """Join findings that differ only in their frames.

    If more than three findings still have the same remedy, join these findings too.
    """
    equal = _joined(findings, attrgetter("reason", "fix", "severity"))
    kinds = Counter(finding.fix for finding in equal)
    few = [finding for finding in equal if kinds[finding.fix] <= _FEW]
    many = [finding for finding in equal if kinds[finding.fix] > _FEW]
    return [*few, *_joined(many, attrgetter("fix", "severity"))]


def _joined(findings: Sequence[Finding], key: Callable[[Finding], Any]) -> list[Finding]:
    joined: dict[Any, Finding] = {}
    for finding in findings:
        known = joined.setdefault(key(finding), finding)
        if known is not finding:
            joined[key(finding)] = replace(known, photos=known.photos + finding.photos)
    return list(joined.values())


@dataclass(frozen=True)
class SceneReport:
    """Findings and measurements of one scene.

    kind: format of the scene. split: train, test, or empty for a format without splits. listed:
    number of photos that the data set lists. decodable: number of these photos that can be decoded.
    missing: number of listed photos whose file does not exist. numbered: number of photos that are
    loaded as frames. pose_problems: number of frames with a wrong pose. epipolar: median distance,
    in pixels, of matched points from their epipolar lines, as text; "-" if no photos were matched,
    "not checked" if the matches do not allow a measurement. depth: median distance from the cameras
    to the point that they look at, in scene units; 0 if they have no common point.
    """

    name: str
    kind: str
    split: str
    listed: int = 0
    decodable: int = 0
    missing: int = 0
    numbered: int = 0
    pose_problems: int = 0
    epipolar: str = "-"
    depth: float = 0.0
    findings: Sequence[Finding] = ()


@dataclass(frozen=True)
class CheckReport:
    """Result of checking a data set.

    general: findings about files of the data set, not about a scene. notes: further sentences for
    the user.
    """

    scenes: Sequence[SceneReport]
    general: Sequence[Finding]
    notes: Sequence[str]

    @property
    def table(self) -> list[list[str]]:
        """Rows of a table: its headers, then one for each scene; of many scenes, for the worst."""
        rows = [["scene", "format", "frames", "decodable", "missing", "bad poses", "epipolar px"]]
        for scene in sorted(self.scenes, key=lambda scene: -len(scene.findings))[:_ROWS]:
            counts = (scene.listed, scene.decodable, scene.missing, scene.pose_problems)
            rows.append([scene.name, scene.kind, *map(str, counts), scene.epipolar])
        if len(self.scenes) > _ROWS:
            rows.append([f"and {len(self.scenes) - _ROWS} more"])
        return rows

    @property
    def findings(self) -> list[Finding]:
        """All findings: errors, then warnings; in each group, files precede scenes."""
        found = [*self.general, *(f for scene in self.scenes for f in scene.findings)]
        return sorted(found, key=lambda finding: finding.severity != "error")
