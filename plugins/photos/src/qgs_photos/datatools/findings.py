"""What a check finds: faults with scene, frames and remedy, one line each."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from typing import Any, Literal, TypeAlias

from qgs.wording import listed

Severity: TypeAlias = Literal["error", "warning"]

_FEW = 3


@dataclass(frozen=True)
class Finding:
    """A fault and its remedy. frames, names: as listed. An error makes results wrong.

    numbers: of the frames, as `DecodedScene.numbers`; those of `frames` where none are given.
    """

    scene: str
    reason: str
    fix: str
    frames: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    severity: Severity = "error"
    numbers: tuple[int | None, ...] = ()

    @property
    def place(self) -> str:
        """The frames as text; empty where the whole scene is meant."""
        if not self.frames:
            return ""
        names = [name for name in self.names if name]
        numbers = [number for number in self.numbers or self.frames if number is not None]
        if not numbers:
            return listed(names, 3)
        named = f" ({names[0]}{f' to {names[-1]}' if len(names) > 1 else ''})" if names else ""
        return f"frame{'s' if len(numbers) > 1 else ''} {spans(numbers)}{named}"

    def __str__(self) -> str:
        where = f"{self.scene}, {self.place}" if self.frames else self.scene
        return " ".join(f"{self.severity}: {where}: {self.reason}: {self.fix}".split())


def errors_of(findings: Iterable[Finding]) -> list[Finding]:
    """Those of `findings` that are errors."""
    return [finding for finding in findings if finding.severity == "error"]


def spans(numbers: Iterable[int]) -> str:
    """Numbers as text, such as 0-3, 7; after eight runs the rest is counted."""
    # numbers of one run are all equally far ahead of their places
    grouped = groupby(enumerate(sorted(set(numbers))), lambda item: item[1] - item[0])
    runs = [[number for _, number in run] for _, run in grouped]
    shown = [f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs[:8]]
    more = sum(map(len, runs[8:]))
    return ", ".join(shown) + (f" and {more} more" if more else "")


def merged(findings: Sequence[Finding]) -> list[Finding]:
    """One finding for all frames with the same fault; for more than three, the same remedy."""
    equal = _together(findings, attrgetter("reason", "fix", "severity"))
    kinds = Counter(finding.fix for finding in equal)
    few = [finding for finding in equal if kinds[finding.fix] <= _FEW]
    many = [finding for finding in equal if kinds[finding.fix] > _FEW]
    return [*few, *_together(many, attrgetter("fix", "severity"))]


def _together(findings: Sequence[Finding], key: Callable[[Finding], Any]) -> list[Finding]:
    together: dict[Any, Finding] = {}
    for finding in findings:
        if known := together.get(key(finding)):
            both = {
                k: getattr(known, k) + getattr(finding, k) for k in ("frames", "names", "numbers")
            }
            finding = replace(known, **both)
        together[key(finding)] = finding
    return list(together.values())
