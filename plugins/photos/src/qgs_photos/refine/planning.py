"""What `qgs scene` chooses: the model, photo size and number of Gaussians that fit the time."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter

import torch
from rich.console import Console
from torch import Tensor

from qgs.checkpoint.model_file import load
from qgs.cli.options import scale_settings
from qgs.contracts import Frames, Scene
from qgs.data.inputs import choose_windows
from qgs.data.recognition import open_for
from qgs.data.samples import held_out_frames, views_in
from qgs.domain import Domain
from qgs.machine import available_bytes
from qgs.metrics.images import psnr
from qgs.model import QueryGaussianModel
from qgs.recipe import resolve
from qgs.recipe.registry import load_usable_plugins
from qgs.reconstruction.scale import further_photos
from qgs.reconstruction.scenes import Size, installed_sources, named_scene, reconstruct
from qgs.types import Gaussians
from qgs.wording import listed
from qgs_photos.refine.refining import NO_EXTRAS, Extras

NONE = "none"
"""As a model: the start is made of the photos alone; as a holdout: all are optimised on."""
SIZES = range(96, 2161, 16)
"""Shorter sides that are considered, pixels."""
LEAST_STEPS, STEPS_OF_PHOTO = 4000, 25
"""Steps that a refinement takes at least, and of each photo; then photos may be larger.

1,600 steps on 320 x 320 pixels gave less, at any size, than 2,000 on 128 x 128 did in a fifth of
the time."""
DENSITY = 0.6
"""Gaussians over pixels of a photo: twice as many gained less than their time."""
MOST_GAUSSIANS = 262_144
_BYTES = 16  # of memory for each value of a photo, at all its sizes: half of it is kept free
_OF_PIXELS, _OF_GAUSSIANS = 0.77, 0.3  # exponents of the time of a step, measured on CPUs
_COARSE = 0.9  # time of a step in the mean over coarse levels, over that of a start at full size
_PROBE = 128  # shorter side with which a step is timed
_SEARCH = 0.15  # part of the time in which models are compared
_JUDGED = 4  # photos on which they are


@dataclass(frozen=True)
class Plan:
    """All that `qgs scene` chose, so that it can be run again. seconds: of refinement."""

    model: str
    frames: Sequence[str]
    scale: float
    size: Size
    gaussians: int
    seconds: float
    holdout: str
    extras: Extras = NO_EXTRAS
    masks: bool = False

    def command(self, photos: str, out: str, scene: str | None = None) -> str:
        """A command line that makes the scene again."""
        height, width = self.size
        options = {
            "--out": out,
            **({"--scene": scene} if scene else {}),
            "--model": self.model,
            **({"--frames": ",".join(self.frames)} if self.frames else {}),
            **({"--scale": f"{self.scale:.5g}"} if self.frames else {}),
            "--size": f"{height}x{width}",
            "--gaussians": str(self.gaussians),
            "--seconds": f"{self.seconds:.0f}" if self.seconds >= 10 else f"{self.seconds:.2g}",
            "--holdout": self.holdout,
        }
        words = [photos, *(word for option in options.items() for word in option)]
        words += ["--degree", str(self.extras.degree)]
        flags = {"exposure": self.extras.exposure, "refine-poses": self.extras.poses}
        words += [f"--{flag}" for flag, given in {**flags, "masks": self.masks}.items() if given]
        return " ".join(["qgs scene", *map(shlex.quote, words)])


def judged_frames(scene: Scene, holdout: str) -> Frames:
    """Frames that are judged and never optimised on.

    holdout: NONE, or n as of `held_out_frames`; a split of the photos' own goes first. Raises
    ValueError for another text.
    """
    if holdout == NONE:
        return ()
    if not holdout.isdecimal() or int(holdout) < 2:
        raise ValueError(f"--holdout must be none or every how many, such as 8; got {holdout!r}")
    return tuple(scene.held_out) or held_out_frames(len(scene), int(holdout))


def shipped_models() -> list[str]:
    """Names of the models that installed plugins ship and whose files are there.

    Those of worlds, which were trained for photos, come first.
    """
    registry, _ = load_usable_plugins()
    models = [pair for plugin in registry.plugins.values() for pair in plugin.models.items()]
    names = (name for name, file in models if file.is_file())
    return sorted(names, key=lambda name: (not name.startswith("worlds/"), name))


@dataclass(frozen=True)
class Start:
    """Where the optimisation begins: a model's Gaussians (1, G), or none of a model.

    world: reference pose (4, 4) and scale, as of `own_world`. quality: PSNR in dB on photos near
    the inputs.
    """

    model: str
    world: tuple[Tensor, Tensor]
    gaussians: Gaussians | None = None
    frames: Sequence[str] = ()
    quality: float = 0.0


def best_start(
    scenes: Scenes, models: Sequence[str], seconds: float, device: str, console: Console
) -> Start:
    """The start of the model that renders photos near the inputs best.

    All take the inputs that the user named, or else those that the first one would choose. No
    further model is tried once _SEARCH of `seconds` is spent. Raises ValueError for no model.
    """
    if not models:
        raise ValueError(
            "no trained model is installed: install query-gaussians-worlds, or name one (--model)"
        )
    began, starts = perf_counter(), list[Start]()
    inputs: str | Frames | None = scenes.inputs
    for name in models:
        if starts and perf_counter() - began > _SEARCH * seconds:
            break
        model = load(name, device)
        if inputs is None:
            views, trained_on = resolve(model.recipe or {}).views, model.trained_on or Domain()
            inputs = choose_windows(scenes.probe, views, trained_on)[0][0]
        starts.append(_start(scenes, name, model, inputs))
    best = max(starts, key=lambda start: start.quality)
    if len(starts) > 1:
        scores = listed(f"{start.model} {start.quality:.2f} dB" for start in starts)
        console.print(f"photos near the inputs: {scores}", highlight=False, style="dim")
    return best


def _start(scenes: Scenes, name: str, model: QueryGaussianModel, frames: str | Frames) -> Start:
    """What the model `name` makes of these inputs."""
    scene = scenes.probe
    result = reconstruct(
        model,
        scenes.photos,
        frames=frames,
        compare=scenes.held,
        scene=scenes.name,
        overrides=scale_settings(scenes.scale),
    )
    inputs = result.sample.input_frames
    judged = further_photos(scene, inputs, (), _JUDGED) or inputs
    photos = views_in(result.world, scene, judged).to(result.gaussians.means.device)
    with torch.no_grad():
        rendered = model.render(result.gaussians, photos.cameras).rgb
    quality = float(psnr(rendered, photos.images).mean())
    names = [scene.frame_name(frame) for frame in inputs]
    return Start(name, result.world, result.gaussians, names, quality)


class Scenes:
    """The photos of `qgs scene` at any size.

    probe: at a small size. held: frames that are judged, and frames: those that are optimised on.
    inputs, scale: for the model, None where it chooses.
    """

    def __init__(
        self, photos: str, name: str | None, holdout: str, inputs: str | None, scale: float | None
    ) -> None:
        self.photos, self.name, self.inputs, self.scale = photos, name, inputs, scale
        self._sources = installed_sources()
        found = self.at(None)
        self.probe = self.at(sized(found, _PROBE))
        self.held = judged_frames(found, holdout)
        self.frames = tuple(frame for frame in range(len(found)) if frame not in self.held)
        self.probe.held_out = self.held

    def at(self, size: Size | None) -> Scene:
        """The scene with photos of this size (H, W)."""
        return named_scene(
            open_for(self.photos, size, None, self._sources)[0], self.photos, self.name
        )


def sized(scene: Scene, side: int) -> Size:
    """(H, W) of whole photos of `scene` with this shorter side, never larger than stored."""
    stored = scene.stored_size(0) or scene.cameras.size
    factor = min(side / min(stored), 1.0)
    height, width = (max(round(factor * length), 1) for length in stored)
    return height, width


def affordable(
    step: float,
    timed: Size,
    timed_count: int,
    scenes: Scenes,
    seconds: float,
    wanted: tuple[Size | None, int | None],
) -> tuple[Size, int]:
    """Photo size and number of Gaussians with which `seconds` are enough steps, and memory is.

    step: seconds of a step at the size `timed` with `timed_count` Gaussians; the time of others
    follows by powers. wanted: what the user set, None where it is free.
    """
    steps = max(LEAST_STEPS, STEPS_OF_PHOTO * len(scenes.frames))
    best: tuple[Size, int] | None = None
    available = available_bytes()
    for size in _sizes(scenes.probe, wanted[0]):
        count = wanted[1] or min(round(DENSITY * math.prod(size)), MOST_GAUSSIANS)
        of_pixels = (math.prod(size) / math.prod(timed)) ** _OF_PIXELS
        time = _COARSE * step * of_pixels * (count / timed_count) ** _OF_GAUSSIANS
        memory = 3 * math.prod(size) * len(scenes.frames) * _BYTES
        if best is not None and (steps * time > seconds or memory > available):
            break
        best = size, count
    assert best is not None
    return best


def _sizes(scene: Scene, wanted: Size | None) -> Iterator[Size]:
    """The wanted size, else those of SIZES up to the stored one, ascending."""
    if wanted is not None:
        yield wanted
        return
    sizes = [sized(scene, side) for side in SIZES]
    yield from dict.fromkeys(sizes)
