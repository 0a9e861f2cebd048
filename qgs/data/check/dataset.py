"""`qgs data check`: all scenes of a data set, whatever its format."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal, TypeAlias, cast

import numpy as np
from upath import UPath

from qgs.data.check.chunk_files import chunk_folders
from qgs.data.check.finding import Finding
from qgs.data.check.folders import dl3dv_scenes, photo_folders
from qgs.data.check.indices import Held, IndexSummary, found_indices, index_findings
from qgs.data.check.photo import Candidate
from qgs.data.check.scene import SceneReport, check_scene
from qgs.data.readers import READERS, Format, read_listing
from qgs.data.recognition import recognised

CheckedFormat: TypeAlias = Literal[
    "auto", "nerfstudio", "blender", "colmap", "llff", "chunks", "dl3dv"
]


_LISTINGS = (".json", ".npy")


@dataclass(frozen=True)
class Options:
    """How thorough a check is.

    geometry: poses are judged against photos in so many scenes, spread over the data set.
    headers_only: no image is decoded, and none is matched. images: folder of photos to read instead
    of the listed one, such as images_4.
    """

    geometry: int = 20
    headers_only: bool = False
    threads: int = 8
    format: CheckedFormat = "auto"
    images: str | None = None


@dataclass(frozen=True)
class CheckReport:
    """What was found. general: findings about files of the data set. judged: scenes whose poses
    were to be judged against photos. notes: what was not done, and why.
    """

    path: str
    scenes: Sequence[SceneReport]
    general: Sequence[Finding]
    indices: Sequence[IndexSummary]
    judged: int
    notes: Sequence[str]

    @property
    def findings(self) -> list[Finding]:
        """All findings, those of files first, then scene by scene; errors before warnings."""
        found = [*self.general, *(f for scene in self.scenes for f in scene.findings)]
        return sorted(found, key=lambda finding: finding.severity != "error")

    @property
    def errors(self) -> int:
        """Number of findings that are errors."""
        return sum(finding.severity == "error" for finding in self.findings)


def check(
    path: UPath,
    options: Options,
    indices: Sequence[UPath] = (),
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> CheckReport:
    """Check the data set at `path`, and evaluation indices: those given and those beside it.

    progress: called with scenes done, scenes in all and a name. Raises FileNotFoundError when there
    is no data set at `path`, or no file at one of `indices`.
    """
    if path.is_file() and path.suffix in _LISTINGS:
        path = path.parent
    candidates, general, told = _candidates(path, options)
    if not candidates and not general:
        read_listing(path, _photo_format(options))  # tells what is missing
        raise FileNotFoundError(f"{path} holds no {options.format}: leave --format out")
    chosen, notes = _geometry_scenes(len(candidates), options)
    scenes: list[SceneReport] = []
    for number, candidate in enumerate(candidates):
        progress(number, len(candidates), candidate.name)
        scenes.append(
            check_scene(
                candidate,
                threads=options.threads,
                headers_only=options.headers_only,
                with_geometry=number in chosen,
            )
        )
    summaries: list[IndexSummary] = []
    held = _held(scenes)
    for file in dict.fromkeys(file.resolve() for file in (*indices, *found_indices(path))):
        findings, summary = index_findings(file, held, told)
        general += findings
        summaries += [summary] if summary else []
    return CheckReport(str(path), scenes, general, summaries, len(chosen), notes)


def _candidates(path: UPath, options: Options) -> tuple[list[Candidate], list[Finding], set[str]]:
    """Scenes, findings about files, and names of scenes that such findings may be about."""
    kind = _kind(path, options.format)
    if kind == "chunks":
        folders = chunk_folders(path)
        return (
            [candidate for folder in folders for candidate in folder.candidates],
            [finding for folder in folders for finding in folder.findings],
            {key for folder in folders for key in folder.index},
        )
    if kind == "dl3dv":
        return dl3dv_scenes(path, options.images), [], set()
    items = list(photo_folders(path, _photo_format(options), options.images))
    return (
        [item for item in items if isinstance(item, Candidate)],
        [item for item in items if isinstance(item, Finding)],
        set(),
    )


def _photo_format(options: Options) -> Format:
    return cast(Format, options.format if options.format in READERS else "auto")


def _kind(path: UPath, wanted: CheckedFormat) -> str:
    if wanted != "auto":
        return wanted
    if path.is_file() and path.suffix == ".torch":
        return "chunks"
    return recognised(path).removeprefix("qgs/")


def _geometry_scenes(count: int, options: Options) -> tuple[set[int], list[str]]:
    """The scenes whose poses are judged against photos, and what to tell of the others."""
    if options.headers_only:
        return set(), ["quick: only headers of images were read, and no pose was judged by photos"]
    if find_spec("skimage") is None:
        return set(), [
            "no pose was judged by photos, which needs scikit-image: `pip install qgs[check]`"
        ]
    if not options.geometry:
        return set(), ["no pose was judged by photos (--geometry 0)"]
    places = np.linspace(0, max(count - 1, 0), min(options.geometry, count)).round().astype(int)
    chosen = set(places.tolist())
    if len(chosen) < count:
        left = f"poses were judged by photos in {len(chosen)} of {count} scenes; --geometry {count}"
        return chosen, [f"{left} judges all"]
    return chosen, []


def _held(scenes: Sequence[SceneReport]) -> dict[str, list[Held]]:
    held: dict[str, list[Held]] = defaultdict(list)
    for scene in scenes:
        held[scene.scene].append(Held(scene.split, scene.listed - scene.missing or None))
    return held
