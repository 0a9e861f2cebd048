"""Sections of a recipe that are not components: views, training, evaluation."""

from typing import Literal, TypeAlias

from pydantic import Field, field_validator

from qgs.contracts.component import ComponentConfig, OptionError
from qgs.precision import Precision

Tuned: TypeAlias = Literal["queries", "latents"]
"""Parts that can be tuned at test time."""


class ViewsConfig(ComponentConfig):
    """How views are drawn from a scene and brought into the model's frame (TokenGS release)."""

    inputs: int = Field(default=4, ge=1)
    """Input views per sample."""
    targets: int = Field(default=4, ge=1)
    """Target views per sample, drawn from the span of the inputs."""
    gap: tuple[int, int] = (10, 40)
    """[min, max] frames, or times where they are known, from the first input to the last, which
    count too; it shrinks to what a scene has, with a warning where that is below min."""
    frame: Literal["first_cam", "mean_cam", "given"] = "first_cam"
    """The camera that becomes the identity: the first input, the mean of inputs; "given": none."""
    scale: Literal["constant", "distance", "auto", "search"] = "constant"
    """Translations are multiplied by `scale_factor`; with "distance", they are divided by the
    largest distance from the first input camera to another one before. "auto" takes one factor per
    scene, which brings the point nearest to the optical axes of all its cameras to a depth of 1.
    "search", for reconstructions alone, takes the one at which the model renders photos best."""
    scale_factor: float = Field(default=0.15, gt=0)
    """Factor of all translations, see `scale`; no effect with "auto" and "search"."""
    mirror: float = Field(default=0.5, ge=0, le=1)
    """Probability of mirroring a training sample in x."""
    pose_noise: float = Field(default=0.0, ge=0, le=45)
    """Degrees by which the poses of the inputs are off, in training and evaluation: the standard
    deviation, about each axis, of their rotation and of their direction from the first input,
    which sets the world and is exact, as targets are. What is reconstructed keeps its poses."""

    @field_validator("gap")
    @classmethod
    def _gap_is_ordered(cls, gap: tuple[int, int]) -> tuple[int, int]:
        # Here and not by limits, so that the fix can name the numbers in order.
        low, high = gap
        if not 1 <= low <= high:
            raise OptionError(
                f"must be [min, max] with 1 <= min <= max, got [{low}, {high}]",
                f"write [{max(min(gap), 1)}, {max(*gap, 1)}], in frames",
            )
        return gap


class TrainingConfig(ComponentConfig):
    """How a model is trained, the optimiser aside (defaults: LocusGS release, base stage)."""

    steps: int = Field(default=150_000, ge=1)
    """Optimiser steps."""
    seconds: float | None = Field(default=None, gt=0)
    """Time budget; training ends when this or `steps` is used up. null: `steps` alone."""
    batch_size: int = Field(default=16, ge=1)
    """Scenes per optimiser step, over all processes; they split evenly over processes and
    `accumulate`."""
    accumulate: int = Field(default=1, ge=1)
    """Batches that a process makes of its scenes of a step, one after the other: less memory."""
    clip: float = Field(default=1.0, gt=0)
    """Largest norm of the gradient; a larger one is scaled down to it."""
    precision: Precision = "bf16"
    """What the model computes in; bf16 is torch's autocast, weights stay float32."""
    save_every: int = Field(default=1000, ge=0)
    """Steps between checkpoints; 0 saves at the end and before evaluations only."""
    collapse_window: int = Field(default=50, ge=10, le=100)
    """Steps in a row without signs of life (empty renderings, no gradient) that end training."""
    workers: int = Field(default=0, ge=0)
    """Processes that decode data; 0 for a thread of the training process."""
    render_views: int = Field(default=0, ge=0)
    """Target views rendered at a time, which bounds memory and changes no gradient; 0 for all."""
    judge_inputs: bool = False
    """Whether the input views are rendered and judged as target views are, after them."""
    ema: float | None = Field(default=None, gt=0, lt=1)
    """Decay of a moving average of the weights, saved and evaluated beside them; null for none."""
    on_nonfinite: Literal["stop", "skip"] = "stop"
    """What a step with a NaN or infinite loss or gradient does; its first bad tensor is named."""
    on_bad_sample: Literal["stop", "skip"] = "stop"
    """What a sample that cannot be made does, of a damaged image for example; "skip" takes one of
    the next scenes instead, with a warning."""
    evaluate_every: int = Field(default=0, ge=0)
    """Steps between evaluations with pictures; 0 for none."""
    trackers: tuple[str, ...] = ()
    """Further destinations of numbers and pictures: tensorboard, wandb, or a plugin's; the folder
    of the run always has them."""

    def scenes_per_batch(self, processes: int) -> int:
        """Scenes in a batch of one of `processes`; ValueError where they do not split evenly."""
        parts = processes * self.accumulate
        scenes, left = divmod(self.batch_size, parts)
        if left:
            # The multiples below and above; 0 scenes are no batch.
            below = max(scenes, 1)
            near = f"{below * parts} or {(below + 1) * parts}"
            raise ValueError(
                f"training.batch_size: {self.batch_size} scenes do not split evenly over "
                f"{processes} x {self.accumulate} (processes x training.accumulate): choose a "
                f"multiple of {parts}, such as {near}"
            )
        return scenes


class EvaluationConfig(ComponentConfig):
    """What `qgs eval` runs: which views are judged, after how much tuning; see also `metrics`."""

    scenes: int = Field(default=32, ge=1)
    """Test scenes, and windows of one with held-out frames, at most; no effect beside `index`."""
    samples: int = Field(default=1, ge=1)
    """Samples drawn from a scene; no effect beside `index` and for scenes with held-out frames."""
    seed: int = Field(default=0, ge=0)
    """Of the samples that are drawn; no effect where `samples` has none."""
    index: str | None = None
    """JSON file {scene: null | {"context": [frames], "target": [frames]}} of the views to judge
    (pixelSplat's format), relative to the working directory; null draws them."""
    protocol: str | None = None
    """Name of these settings in tables; null takes the name of the index file."""
    tuning: Tuned = "queries"
    """What tuning fits to a scene's input views: its queries, or the features of its image memory,
    with an encoder that makes keys and values of them anew."""
    tuning_steps: int = Field(default=0, ge=0)
    """Steps of tuning on the input views of each scene before it is judged, with the recipe's
    photometric loss (TokenGS: 50); 0 for none."""
    tuning_rate: float | None = Field(default=None, gt=0)
    """Learning rate of tuning, by Adam; null for TokenGS's, 1e-4 of queries and 1e-2 of latents."""

    @property
    def rate(self) -> float:
        """`tuning_rate`, or the default of what is tuned."""
        # TokenGS tunes features with a hundred times the rate of queries.
        return self.tuning_rate or {"queries": 1e-4, "latents": 1e-2}[self.tuning]
