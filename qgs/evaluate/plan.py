"""Views that an evaluation scores: chosen at random with a seed, or listed in an index file."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from qgs.contracts import EvaluationConfig, Scene, SceneSource, ViewSampler, ViewsConfig, Window
from qgs.contracts.schedule import END
from qgs.data.samples import Frames, Sample, make_sample
from qgs.data.view_samplers import evenly, gap_range, moments, spread
from qgs.paths import opened_path, read_json
from qgs.wording import listed

FrameList = Annotated[list[Annotated[int, Field(strict=True)]], Field(min_length=1)]


class IndexEntry(BaseModel):
    """Frames of one scene in an index file, as positions in the scene's list of frames.

    Other keys of a scene are ignored.
    """

    model_config = ConfigDict(frozen=True)

    context: FrameList
    """Input frames. The camera of the first input frame defines the model's coordinate frame."""
    target: FrameList
    """Target frames, which are rendered and scored."""


EvaluationIndex = Mapping[str, IndexEntry | None]
"""Frames by scene name; None for a scene that is listed but not scored."""

ViewsOf = Callable[[Scene, Frames, Frames], ViewsConfig]
"""Function of a scene, its input frames and its target frames that returns view settings."""

_FORM = '{"scene": null or {"context": [frames], "target": [frames]}}'


def read_index(path: str | None) -> EvaluationIndex | None:
    """Read the JSON file `path`, a local path or a URL of fsspec; return None if `path` is None.

    Raises FileNotFoundError for a missing file, and ValueError for a file that has another form or
    names no scene to score.
    """
    if path is None:
        return None
    file = opened_path(path)
    if not file.is_file():
        raise FileNotFoundError(
            f"there is no evaluation index at {path}; evaluation.index is a JSON file of the form "
            f"{_FORM}, relative to the working directory"
        )
    written = read_json(file, f"write {_FORM}")
    try:
        index = TypeAdapter(dict[str, IndexEntry | None]).validate_python(written)
    except ValidationError as error:
        wrong = [f"{'.'.join(map(str, e['loc'])) or 'file'}: {e['msg']}" for e in error.errors()]
        reason = listed(wrong, between="; ")
        raise ValueError(f"{path} is no evaluation index of the form {_FORM}: {reason}") from error
    if not any(index.values()):
        raise ValueError(f"the evaluation index {path} names no scene to score")
    return index


@dataclass
class EvaluationPlan:
    """Samples that an evaluation scores: scenes of the test split and their views.

    With `evaluation.index`, the index file names scenes and frames. Without an index, the first
    `evaluation.scenes` scenes are scored. The samples of a scene are the first of these that exist:

    1. the windows (input and target frames) of `sampler.windows`,
    2. the windows of `held_out_windows`, if the scene has held-out frames,
    3. `evaluation.samples` random samples of `sampler`, with `evaluation.seed` and the sampler's
       options at the end of training. Targets are all other frames between the first and the last
       input; in a scene with times, they are the targets that `sampler` chooses.

    In 1 and 2, at most `evaluation.scenes` windows of a scene are kept, evenly spread. Targets at
    several times become one sample for each time. No sample is mirrored.

    views_of: function that returns the view settings of a sample, such as its scale; None uses
        `views`. depths: load true depth for targets if the scene has it. wanted: names of the
        scenes to score. Raises ValueError if the data has no test scenes, and the errors of
        `read_index`.
    """

    source: SceneSource
    views: ViewsConfig
    evaluation: EvaluationConfig
    sampler: ViewSampler
    views_of: ViewsOf | None = None
    depths: bool = False

    def __post_init__(self) -> None:
        self.index = read_index(self.evaluation.index)
        self._scenes = self.source.scenes("test")
        if not len(self._scenes):
            raise ValueError(f"the data source {type(self.source).name!r} has no test scenes")
        names = self.source.names("test")
        self._places = {name: place for place, name in enumerate(names)}
        self.wanted = tuple(names[: self.evaluation.scenes])
        if self.index is not None:
            self.wanted = tuple(name for name, entry in self.index.items() if entry)

    def samples(self, name: str) -> Iterator[Sample]:
        """Yield the samples of the scene `name`, decoding the images of one sample at a time.

        Raises ValueError for an unknown scene, and the errors of the scene's reader.
        """
        if name not in self._places:
            raise ValueError("the test split has no such scene: correct its name in the index")
        place = self._places[name]
        scene = self._scenes[place]
        # a generator for each scene: a failing one changes no noise of the others
        noise = np.random.default_rng([self.evaluation.seed, place])
        for inputs, targets in self._choices(scene, place):
            views = self.views_of(scene, inputs, targets) if self.views_of else self.views
            for part in [targets] if scene.times is None else moments(scene, targets):
                yield make_sample(scene, inputs, part, views, False, noise, self.depths)

    def _choices(self, scene: Scene, place: int) -> Iterator[Window]:
        """Yield input and target frames of each sample.

        place: number of the scene in the test split.
        """
        sampler = self.sampler
        # What somebody chose comes first: an index, then windows of the sampler's own. Held-out
        # photos are scarce, so all of them are compared before any frame is drawn by chance.
        if self.index is not None:
            yield _named(scene, self.index)
        elif windows := sampler.windows(scene, self.views):
            yield from evenly(windows, self.evaluation.scenes)
        elif scene.held_out:
            yield from evenly(held_out_windows(scene, self.views), self.evaluation.scenes)
        else:
            for k in range(self.evaluation.samples):
                rng = np.random.default_rng([self.evaluation.seed, place, k])
                # At the end of training: a sampler may widen its gap with the steps.
                inputs, drawn = sampler.draw(scene, self.views, rng, END)
                every = range(inputs[0], inputs[-1] + 1) if scene.times is None else drawn
                yield inputs, tuple(sorted({*every} - {*inputs} or {*drawn}))


def held_out_windows(scene: Scene, views: ViewsConfig) -> list[Window]:
    """Return windows (input frames, target frames) in which each held-out frame is a target once.

    A window is made for each held-out frame, in order, that is no target of an earlier window. The
    window is centred on this frame, and shifted to lie inside the scene. Its length is the upper
    limit of `views.gap`, counted in training frames or, in a scene with times, in different times.
    Its inputs are evenly spaced training frames. Its targets are all held-out frames between the
    first and the last input that are no targets of earlier windows.
    """
    usable = moments(scene)
    gap = gap_range(len(usable), views, scene)[1]
    when = np.arange(len(scene)) if scene.times is None else scene.times.numpy()
    starts = when[[frames[0] for frames in usable]]
    windows: list[Window] = []
    covered: set[int] = set()
    for frame in sorted(scene.held_out, key=lambda frame: (when[frame], frame)):
        if frame in covered:
            continue
        centre = int(np.searchsorted(starts, when[frame]))
        # centred, and at the ends of the scene shifted into it
        first = min(max(centre - (gap + 1) // 2, 0), len(usable) - 1 - gap)
        span = usable[first : first + gap + 1]
        start = when[span[0][0]]
        end = when[span[-1][0]]
        inside = {f for f in scene.held_out if start < when[f] < end or when[f] == when[frame]}
        targets = sorted(inside - covered)
        covered.update(targets)
        windows.append((spread(span, views.inputs), tuple(targets)))
    return windows


def _named(scene: Scene, index: EvaluationIndex) -> Window:
    """Return input and target frames of `scene` from `index`.

    Raises ValueError if the scene lacks some of these frames, or if any of its images is missing.
    """
    entry = index[scene.name]
    assert entry is not None
    # frames are positions, which a missing image moves
    if scene.missing:
        raise ValueError(
            f"{len(scene.missing)} images of the scene do not exist, so the frame numbers in the "
            f"evaluation index would mean other frames. Restore {listed(scene.missing, 3)}"
        )
    outside = [f for f in (*entry.context, *entry.target) if not 0 <= f < len(scene)]
    if outside:
        ends = f"{scene.label(0)} to {scene.label(len(scene) - 1)}"
        raise ValueError(f"the index names frames {listed(outside)}, but the scene has only {ends}")
    return tuple(entry.context), tuple(entry.target)
