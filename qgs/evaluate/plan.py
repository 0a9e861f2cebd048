"""Views that an evaluation compares: drawn by seed, or named by an index file."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from qgs.contracts import EvaluationConfig, Scene, SceneSource, ViewSampler, ViewsConfig, Window
from qgs.contracts.schedule import END
from qgs.data.samples import Frames, Sample, make_sample
from qgs.data.view_samplers import evenly, gap_range, moments, spread
from qgs.paths import opened_path, read_json
from qgs.wording import listed

FrameList: TypeAlias = Annotated[list[Annotated[int, Field(strict=True)]], Field(min_length=1)]


class IndexEntry(BaseModel):
    """Frames of one scene, as positions in its list of frames.

    Other keys of the file are ignored.
    """

    model_config = ConfigDict(frozen=True)

    context: FrameList
    """The input frames; the first sets the model's frame."""
    target: FrameList
    """The target frames."""


EvaluationIndex: TypeAlias = Mapping[str, IndexEntry | None]
"""Scene name to its frames; None for a scene that is listed but not judged."""

ViewsOf: TypeAlias = Callable[[Scene, Frames, Frames], ViewsConfig]
"""Function of a scene, input and target frames; it returns the settings of their sample."""

_FORM = '{"scene": null or {"context": [frames], "target": [frames]}}'


def read_index(path: str | None) -> EvaluationIndex | None:
    """Read the index in the JSON file `path`, which may be an fsspec URL; None for no path.

    Raises FileNotFoundError, and ValueError for another form and for no scene to judge.
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
        raise ValueError(f"{path} is no evaluation index {_FORM}: {reason}") from error
    if not any(index.values()):
        raise ValueError(f"the evaluation index {path} names no scene to judge")
    return index


@dataclass
class EvaluationPlan:
    """Scenes of a test split to judge, with their views; never mirrored.

    With `evaluation.index`, its scenes and frames. Without one, of the first `evaluation.scenes`
    scenes: the windows of `sampler`, else of a scene with held-out frames `held_out_windows`,
    evenly thinned to `evaluation.scenes`; else `evaluation.samples` samples, inputs drawn by
    `sampler` as at the end of training with `evaluation.seed`, targets the other frames of the
    span, or of one time. Targets of T times are T samples. views_of: makes the settings of a
    sample, such as its scale. depths: targets have true depth where scenes do.

    wanted: names of the scenes. Raises ValueError without scenes, and as `read_index`.
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
        """Yield the samples of a wanted scene, one decoded at a time. Raises what a reader raises.

        ValueError for a scene that is not there.
        """
        if name not in self._places:
            raise ValueError("not among the test scenes of the data")
        place = self._places[name]
        scene = self._scenes[place]
        # a generator for each scene: a failing one changes no noise of the others
        noise = np.random.default_rng([self.evaluation.seed, place])
        for inputs, targets in self._choices(scene, place):
            views = self.views_of(scene, inputs, targets) if self.views_of else self.views
            for part in [targets] if scene.times is None else moments(scene, targets):
                yield make_sample(scene, inputs, part, views, False, noise, self.depths)

    def _choices(self, scene: Scene, place: int) -> Iterator[Window]:
        """Yield input and target frames of each sample."""
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
    """Return input and target frames such that every held-out frame is a target once.

    A window of the largest gap (in training frames, or times) is centred on the first such frame
    not yet covered and shifted into the scene, inputs evenly spaced; all within are targets.
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
    """Return the frames of `scene` that `index` names. Raises ValueError if one is missing."""
    entry = index[scene.name]
    assert entry is not None
    # frames are positions, which a missing image moves
    if scene.missing:
        raise ValueError(
            f"{len(scene.missing)} of its listed images do not exist, so that positions "
            f"of the index would mean other frames: {listed(scene.missing, 3)}"
        )
    outside = [f for f in (*entry.context, *entry.target) if not 0 <= f < len(scene)]
    if outside:
        ends = f"{scene.label(0)} to {scene.label(len(scene) - 1)}"
        raise ValueError(f"the index names frames {listed(outside)}, the scene has {ends}")
    return tuple(entry.context), tuple(entry.target)
