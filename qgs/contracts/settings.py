"""Sections of a recipe that are not components: views, training, evaluation."""

from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    Field,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    ValidationInfo,
)

from qgs.contracts.component import ComponentConfig, OptionError
from qgs.precision import Precision


def ascending(ends: tuple[float, float]) -> tuple[float, float]:
    """Return a range [min, max] unchanged. Raises OptionError unless 0 < min <= max."""
    low, high = ends
    # not by limits of the field, so that the fix can give the numbers in order
    if not 0 < low <= high:
        raise OptionError(
            f"must be [min, max] with 0 < min <= max, got [{low:g}, {high:g}]",
            f"write [{min(ends):g}, {max(ends):g}], both above 0",
        )
    return ends


Ascending = Annotated[tuple[float, float], AfterValidator(ascending)]
"""Range [min, max] of positive numbers."""


def rising(numbers: tuple[int, ...]) -> tuple[int, ...]:
    """Return numbers unchanged. Raises OptionError unless each is above 0 and above the last."""
    fixed = sorted({max(number, 1) for number in numbers})
    if list(numbers) != fixed:
        raise OptionError(
            f"must be distinct, ascending and at least 1, got {list(numbers)}", f"write {fixed}"
        )
    return numbers


Rising = Annotated[tuple[int, ...], Field(min_length=1), AfterValidator(rising)]
"""Numbers from 1 on, at least one, in ascending order."""


def behind_near(far: float, info: ValidationInfo) -> float:
    """Return `far` unchanged. Raises OptionError unless it is more than the option `near`."""
    near = info.data.get("near")
    # If `near` is invalid itself, the data lack it.
    if near is not None and far <= near:
        raise OptionError(
            f"far must be more than near, got near {near:g} and far {far:g}",
            f"set far above {near:g}, or near below {far:g}",
        )
    return far


Far = Annotated[PositiveFloat, AfterValidator(behind_near), Field(validate_default=True)]
"""Option `far`, above 0 and above the option `near`, which comes before it."""


def dividing_width(heads: int, info: ValidationInfo) -> int:
    """Return `heads` unchanged. Raises OptionError unless it divides the option `width`."""
    # If the width is invalid itself, the data lack it.
    width = info.data.get("width", heads)
    if width % heads:
        reason = f"{heads} heads do not divide the width {width}"
        raise OptionError(reason, f"write a divisor of {width}")
    return heads


Heads = Annotated[int, Field(ge=1, validate_default=True), AfterValidator(dividing_width)]
"""Option `heads`, from 1 on. It divides the option `width`, which comes before it."""


class ViewsConfig(ComponentConfig):
    """Settings for choosing views of a scene and for moving their cameras to the model's frame.

    The defaults are those of the TokenGS release.
    """

    inputs: PositiveInt = 4
    """Number of input views per sample."""
    targets: PositiveInt = 4
    """Number of target views per sample, chosen at random between the first and the last input
    view."""
    gap: Annotated[tuple[int, int], AfterValidator(ascending)] = (10, 40)
    """Distance from the first to the last input view, as [min, max] in frames. Neighbouring frames
    have distance 1. In scenes with times, neighbouring times have distance 1. If a scene is shorter
    than max, its length replaces max. If it is shorter than min, its length replaces both, and a
    warning is logged."""
    frame: Literal["first_cam", "mean_cam", "given"] = "first_cam"
    """Camera whose pose becomes the identity: "first_cam" is the first input camera, "mean_cam" the
    mean of the input cameras. "given" changes no pose of the data."""
    scale: Literal["constant", "distance", "auto", "search"] = "constant"
    """Rule for scaling camera positions. "constant" multiplies them by `scale_factor`. "distance"
    divides them by the largest distance from the first input camera to any other camera, and then
    multiplies them by `scale_factor`. "auto" computes one factor per scene, which brings the point
    nearest to all optical axes to depth 1. "search" takes the factor at which a trained model
    renders a user's photos best, and works only for these."""
    scale_factor: PositiveFloat = 0.15
    """Factor for all camera positions, see `scale`. It has no effect if `scale` is "auto" or
    "search"."""
    mirror: float = Field(default=0.5, ge=0, le=1)
    """Probability of mirroring a training sample left to right (x axis)."""
    pose_noise: float = Field(default=0.0, ge=0, le=45)
    """Standard deviation of noise on the input poses in training and evaluation, in degrees about
    each axis. One random rotation turns each camera; another turns the camera's position about the
    first input camera. The first input camera and the target cameras stay exact. Reconstruction of
    a user's photos adds no noise. 0: no noise."""


class TrainingConfig(ComponentConfig):
    """Settings of training except for the optimiser (defaults: LocusGS release, base stage)."""

    steps: PositiveInt = 150_000
    """Number of optimiser steps."""
    seconds: PositiveFloat | None = None
    """Time budget in seconds. Training ends when these seconds or `steps` are used up. null: no
    limit on time."""
    batch_size: PositiveInt = 16
    """Number of scenes per optimiser step, summed over all processes. It must be a multiple of the
    number of processes times `accumulate`."""
    accumulate: PositiveInt = 1
    """Number of batches into which each process splits its scenes of an optimiser step. The batches
    are computed one after the other, so a larger number needs less memory."""
    clip: PositiveFloat = 1.0
    """Largest norm of the gradient. A gradient with a larger norm is scaled down to this norm."""
    precision: Precision = "bf16"
    """Precision of the model's computations. bf16 uses torch's autocast; weights stay float32."""
    save_every: NonNegativeInt = 1000
    """Steps between checkpoints. 0: checkpoints only at the end and before evaluations."""
    collapse_window: int = Field(default=50, ge=10, le=100)
    """Stop training after this many steps in a row in which renderings are empty or the gradient
    vanishes."""
    image_sizes: tuple[tuple[PositiveInt, PositiveInt], ...] = ()
    """Sizes [H, W] of training images. Each step takes one at random. []: `data.image_size`, which
    is always the size in evaluation."""
    workers: NonNegativeInt = 0
    """Number of processes that load data. 0: a thread of the training process loads data."""
    render_views: NonNegativeInt = 0
    """Number of target views rendered at a time. Smaller numbers need less memory; gradients stay
    the same. 0: all views at once."""
    judge_inputs: bool = False
    """Compute the losses on input views as well as target views. Input views are rendered last."""
    ema: float | None = Field(default=None, gt=0, lt=1)
    """Decay per step of a moving average of the weights. The average is saved and evaluated in
    addition to the weights. null: no average."""
    on_nonfinite: Literal["stop", "skip"] = "stop"
    """Stop training, or skip the step, when the loss or a gradient is NaN or infinite. The message
    names the first bad tensor."""
    on_bad_sample: Literal["stop", "skip"] = "stop"
    """Stop training, or skip the sample, when a sample fails to load, for example because of a
    damaged image. "skip" uses a sample of one of the next scenes and logs a warning."""
    evaluate_every: NonNegativeInt = 0
    """Number of steps between evaluations during training. An evaluation saves pictures, too. 0: no
    evaluations."""
    trackers: tuple[str, ...] = ()
    """Trackers that log the run: tensorboard, wandb, or a tracker of a plugin. Each gets all
    numbers and pictures; the run's folder has them in any case."""

    def scenes_per_batch(self, processes: int) -> int:
        """Return the number of scenes per batch of one process.

        Raises ValueError if `batch_size` does not split evenly.
        """
        parts = processes * self.accumulate
        scenes, left = divmod(self.batch_size, parts)
        if left:
            # The multiples below and above; a batch needs at least one scene.
            below = max(scenes, 1)
            near = f"{below * parts} or {(below + 1) * parts}"
            raise ValueError(
                f"training.batch_size: {self.batch_size} scenes do not split evenly over "
                f"{processes} x {self.accumulate} (processes x training.accumulate): choose a "
                f"multiple of {parts}, such as {near}"
            )
        return scenes


class EvaluationConfig(ComponentConfig):
    """Settings of `qgs eval` except for the metrics: the views to score, and test-time tuning."""

    scenes: PositiveInt = 32
    """Largest number of test scenes to score. For scenes with held-out frames, it is also the
    largest number of windows (input and target views) per scene. It has no effect if `index` is
    set."""
    samples: PositiveInt = 1
    """Number of samples scored per scene, each with randomly chosen views. It has no effect if
    `index` is set, or for scenes with held-out frames."""
    seed: NonNegativeInt = 0
    """Seed of the noise that `views.pose_noise` adds to input poses, and of the random choice of
    views. Views are chosen at random unless `index` is set or the scene has held-out frames."""
    index: str | None = None
    """JSON file with the views to score, relative to the working directory, in pixelSplat's format:
    {scene: null | {"context": [frames], "target": [frames]}}. A scene with null in the file is
    skipped. Without a file (null), targets are the held-out frames of a scene or, in scenes without
    held-out frames, views are chosen at random."""
    protocol: str | None = None
    """Name of these evaluation settings in tables. null uses the name of the file in `index`,
    or "held-out views" without an index."""
    tuning: Literal["queries", "latents"] = "queries"
    """Part of the model's state that test-time tuning fits to a scene's input views: "queries", or
    the features of the image memory ("latents"). "latents" needs an encoder that can recompute keys
    and values from features."""
    tuning_steps: NonNegativeInt = 0
    """Number of test-time tuning steps on a scene's input views before the scene is scored. They
    minimise the recipe's photometric loss. 0: no tuning (TokenGS uses 50)."""
    tuning_rate: PositiveFloat | None = None
    """Learning rate of test-time tuning with Adam. null: as in TokenGS, 1e-4 for queries, 1e-2 for
    latents."""

    @property
    def rate(self) -> float:
        """Learning rate of tuning: `tuning_rate`, or the default for the part in `tuning`."""
        # TokenGS tunes features with a hundred times the rate of queries.
        return self.tuning_rate or {"queries": 1e-4, "latents": 1e-2}[self.tuning]
