"""Whether a training fits into memory, told before anything is allocated; what to do where not."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import torch
from accelerate import Accelerator

from qgs.composer import Recipe
from qgs.data.evaluation import one_line
from qgs.data.sampling import image_bytes
from qgs.engine.distributed import wants_shards
from qgs.engine.guard import TrainingError
from qgs.memory import available_bytes, in_words, is_out_of_memory, refuse_beyond_memory

LESS_MEMORY = (
    "lower training.batch_size, training.render_views, views.inputs, views.targets, "
    "data.image_size, model.queries.count or model.head.gaussians_per_query"
)

_GAUSSIAN = 14
"""Numbers of a Gaussian: mean, scales, rotation, opacity, colour."""

_RENDERED = 5
"""Numbers of a rendered pixel: RGB, alpha, depth."""


class OutOfMemoryError(TrainingError):
    """A step found no memory; the message says what is kept and what takes less."""


def refuse_unfit(recipe: Recipe, accelerator: Accelerator) -> None:
    """Raise TooLargeError for a training whose least parts do not fit into memory.

    Counted are weights and gradients, batches, Gaussians and renderings with their gradients; what
    layers keep for the backward pass, moments, and Gaussians of queries whose number depends on the
    views, come on top. What lies on a GPU is compared with its free memory.
    """
    config, views, model = recipe.training, recipe.views, recipe.build_model("meta")
    factors = recipe.rate_factors(model)
    sizes = {name: 4 * tensor.numel() for name, tensor in model.state_dict().items()}
    weights, trained = sum(sizes.values()), sum(s for n, s in sizes.items() if factors.get(n))
    shards = accelerator.num_processes if wants_shards(accelerator) else 1
    queries, per_query = model.queries.count or 0, model.head.gaussians_per_query
    layers = len(model.supervision.weights())
    gaussians = config.batch_size * queries * per_query * layers
    on_device = {
        f"the weights, {weights // 4:,}, and their gradients": (weights + trained) // shards,
        f"batch_size {config.batch_size} x {queries} queries x {per_query} Gaussians, in {layers} "
        "layers, and their gradients": 2 * 4 * _GAUSSIAN * gaussians,
    }
    in_host = {"copies of good weights": 2 * weights}
    if data := recipe.data_config:
        size = height, width = data.image_size
        images, batches = config.batch_size * (views.inputs + views.targets), config.accumulate + 1
        judged = views.targets + config.judge_inputs * views.inputs
        rendered = config.batch_size * min(judged, config.render_views or judged)
        on_device["renderings and their gradients"] = 2 * 4 * _RENDERED * rendered * height * width
        counted = f"batch_size {config.batch_size} x ({views.inputs} + {views.targets}) images"
        in_host[f"{counted} of {height} x {width}, {batches} times"] = batches * image_bytes(
            images, size
        )
    advice = f"To train with less, {LESS_MEMORY}."
    if accelerator.device.type == "cuda":
        device = accelerator.device
        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        free = torch.cuda.mem_get_info(device)[0] + cached  # which torch takes again first
        refuse_beyond_memory("this training, on the GPU,", on_device, advice, free)
        on_device = {}
    refuse_beyond_memory("this training", {**on_device, **in_host}, advice)


@contextmanager
def explained(step: int, save: Callable[[int], None] | None = None) -> Iterator[None]:
    """Raise OutOfMemoryError where the `with` block, a step after `step` others, finds no memory.

    save: sees that the run is saved as it is; None where it cannot be saved.
    """
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        kept = "What was saved before stays. " if step else ""
        if step and save:
            with suppress(Exception):  # most likely the same; the earlier state is whole
                save(step)
                kept = f"The run is saved at step {step}. "
        if step:
            kept += (
                "With --resume, training.batch_size may be lowered where training.accumulate is "
                "raised as much, and training.render_views and training.workers be set. "
            )
        raise OutOfMemoryError(
            f"out of memory in step {step + 1} ({in_words(available_bytes())} of main memory are "
            f"available): {one_line(error)}. {kept}A new run takes less when "
            f"you {LESS_MEMORY}."
        ) from error
