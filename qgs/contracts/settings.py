"""Sections of a recipe that are not components: views, training, evaluation."""

from typing import Literal

from pydantic import Field, field_validator

from qgs.contracts.component import ComponentConfig, OptionError
from qgs.precision import Precision


class ViewsConfig(ComponentConfig):
    """Settings for choosing views of a scene and for moving their cameras to the model's frame.

    The defaults are those of the TokenGS release.
    """

    inputs: int = Field(default=4, ge=1)
    """Input views per sample."""
    targets: int = Field(default=4, ge=1)
    """Target views per sample, drawn between the first and the last input."""
    gap: tuple[int, int] = (10, 40)
    """Distance from the first to the last input, [min, max] in frames. Neighbouring frames have
    distance 1. In scenes with times the unit is a distinct time, not a frame. A scene shorter than
    max uses at most its own length; one shorter than min logs a warning."""
    frame: Literal["first_cam", "mean_cam", "given"] = "first_cam"
    """Camera whose pose becomes the identity: "first_cam" is the first input, "mean_cam" the mean
    of the inputs. "given" keeps the poses of the data."""
    scale: Literal["constant", "distance", "auto", "search"] = "constant"
    """Rule for scaling camera positions. "constant" multiplies them by `scale_factor`. "distance"
    first divides them by the largest distance from the first input camera to any other. "auto"
    computes one factor per scene, which brings the point nearest to all optical axes to depth 1.
    "search" takes the factor at which the model renders photos best; only for reconstructions."""
    scale_factor: float = Field(default=0.15, gt=0)
    """Factor for all camera positions, see `scale`. It has no effect with "auto" and "search"."""
    mirror: float = Field(default=0.5, ge=0, le=1)
    """Probability of mirroring a training sample left to right (x axis)."""
    pose_noise: float = Field(default=0.0, ge=0, le=45)
    """Standard deviation of noise on the input poses in training and evaluation, in degrees about
    each axis. A random rotation turns each camera; another one turns its position about the first
    input. The first input and the targets stay exact. Reconstructions ignore this option. 0: no
    noise."""

    @field_validator("gap")
    @classmethod
    def _gap_is_ordered(cls, gap: tuple[int, int]) -> tuple[int, int]:
        # Not by limits of the field, so that the fix can give the numbers in order.
        low, high = gap
        if not 1 <= low <= high:
            raise OptionError(
                f"must be [min, max] with 1 <= min <= max, got [{low}, {high}]",
                f"write [{max(min(gap), 1)}, {max(*gap, 1)}], in frames",
            )
        return gap


class TrainingConfig(ComponentConfig):
    """Training settings, except for the optimiser (defaults: LocusGS release, base stage)."""

    steps: int = Field(default=150_000, ge=1)
    """Number of optimiser steps."""
    seconds: float | None = Field(default=None, gt=0)
    """Time budget in seconds. Training ends when this or `steps` is used up. null: no limit."""
    batch_size: int = Field(default=16, ge=1)
    """Scenes per optimiser step, summed over all processes. It must be a multiple of the number of
    processes times `accumulate`."""
    accumulate: int = Field(default=1, ge=1)
    """Number of batches into which each process splits its scenes of a step. It computes the
    batches one after the other, so a larger number needs less memory."""
    clip: float = Field(default=1.0, gt=0)
    """Largest norm of the gradient. A larger gradient is scaled down to it."""
    precision: Precision = "bf16"
    """Precision of the model's computations. bf16 uses torch's autocast; weights stay float32."""
    save_every: int = Field(default=1000, ge=0)
    """Steps between checkpoints. 0 saves only at the end and before evaluations."""
    collapse_window: int = Field(default=50, ge=10, le=100)
    """Stop training after this many steps in a row in which renderings are empty or the gradient
    vanishes."""
    workers: int = Field(default=0, ge=0)
    """Number of processes that load data. 0 uses a thread of the training process."""
    render_views: int = Field(default=0, ge=0)
    """Number of target views rendered at a time. Smaller numbers need less memory; gradients stay
    the same. 0: all."""
    judge_inputs: bool = False
    """Render the input views too, after the target views, and compute the losses on both."""
    ema: float | None = Field(default=None, gt=0, lt=1)
    """Decay per step of a moving average of the weights. The average is saved and evaluated in
    addition to the weights. null: no average."""
    on_nonfinite: Literal["stop", "skip"] = "stop"
    """Stop training, or skip the step, when the loss or a gradient is NaN or infinite. The message
    names the first bad tensor."""
    on_bad_sample: Literal["stop", "skip"] = "stop"
    """Stop training, or skip the sample, when a sample fails to load, for example because of a
    damaged image. "skip" takes a sample of one of the next scenes and logs a warning."""
    evaluate_every: int = Field(default=0, ge=0)
    """Steps between evaluations during training, which also save pictures. 0: none."""
    trackers: tuple[str, ...] = ()
    """Trackers that get all numbers and pictures, in addition to the run's folder: tensorboard,
    wandb, or a tracker of a plugin."""

    def scenes_per_batch(self, processes: int) -> int:
        """Return the scenes per batch of one process; raise ValueError if it is no integer."""
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
    """Settings of `qgs eval`: the views to score, and test-time tuning. See also `metrics`."""

    scenes: int = Field(default=32, ge=1)
    """Largest number of test scenes to score, and of windows (input and target views) per scene
    with held-out frames. It has no effect if `index` is set."""
    samples: int = Field(default=1, ge=1)
    """Number of samples drawn from each scene. It has no effect if `index` is set, or for scenes
    with held-out frames."""
    seed: int = Field(default=0, ge=0)
    """Seed for drawing the samples. It has no effect where `samples` has no effect."""
    index: str | None = None
    """JSON file with the views to score, relative to the working directory, in pixelSplat's format:
    {scene: null | {"context": [frames], "target": [frames]}}. Scenes with null are skipped. Without
    a file (null), views are drawn."""
    protocol: str | None = None
    """Name of these evaluation settings in tables. null uses the name of the index file."""
    tuning: Literal["queries", "latents"] = "queries"
    """Part that tuning fits to a scene's input views: its queries, or the features of its image
    memory ("latents"). "latents" needs an encoder that recomputes keys and values from features."""
    tuning_steps: int = Field(default=0, ge=0)
    """Number of tuning steps on the input views of each scene before it is scored, with the
    recipe's photometric loss (TokenGS: 50). 0: no tuning."""
    tuning_rate: float | None = Field(default=None, gt=0)
    """Learning rate of tuning (Adam). null: as in TokenGS, 1e-4 for queries, 1e-2 for latents."""

    @property
    def rate(self) -> float:
        """Learning rate of tuning: `tuning_rate`, or the default for the part in `tuning`."""
        # TokenGS tunes features with a hundred times the rate of queries.
        return self.tuning_rate or {"queries": 1e-4, "latents": 1e-2}[self.tuning]
