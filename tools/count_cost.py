"""What trainings cost on large GPUs: FLOPs and bytes counted on "meta", times by published rates.

    python tools/count_cost.py [RECIPE ...] [--check]

Without recipes: the trainings of docs/scale.md. Prints Markdown tables. Nothing is trained and no
memory is taken: both passes of one scene run on "meta" as they would on a GPU with bf16 autocast,

- FLOPs by torch's FlopCounterMode (2 for a multiplication with an addition), which sees matrix
  products and attention. Attention runs as the flash kernel, whose FLOPs torch has a formula for
  (4 N M D forward, 2.5 times that backward: it makes the products of the forward pass again).
  Attention with a bias is a function of our own with products in place, which the counter does
  not see, so it is counted as the flash kernel, and its bias apart: BIAS_FLOPS for each pair of
  query and token. `--check` compares with what the counter sees of the real code;
- activations by saved_tensors_hooks: the bytes of all tensors that the backward pass needs, each
  storage once, without parameters; of one scene and of two, so that what is there once for all
  scenes, such as bf16 copies of the weights, is separated from what each takes;
- memory by `qgs_bench.predict`, as `qgs bench --predict` reports it, and what DDP and FSDP2 change.

The constants below are the assumptions; docs/scale.md gives their sources.
"""

import argparse
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from unittest.mock import patch

import torch
import torch.nn.functional as F
from qgs_bench.predict import Need, need_of
from qgs_bench.work import posed_photos, workload_of
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from qgs.components import AttentionBias, attention_bias, blocks
from qgs.composer import Recipe, resolve
from qgs.model import QueryGaussianModel
from qgs.types import named_tensors

PEAK, PEAK_FLOAT32 = 989e12, 67e12  # FLOP/s of an H200, dense bf16 and float32
MEMORY, BANDWIDTH = 141e9, 4.8e12  # bytes, and bytes/s of its memory
NVLINK, NETWORK = 450e9, 50e9  # bytes/s of a GPU in one direction: NVLink 900 GB/s, 400 Gb/s
UTILISATION = (0.30, 0.45)  # of PEAK
LAUNCH = {0.30: 10e-6, 0.45: 5e-6}  # s that an operation takes at least, launched by itself
LINK_USE = 0.8  # of the links' rates that large messages reach
BIAS_FLOPS = 3 * 22  # of a pair: cross product, square, scale, clamp; forward, again, derivative
RENDER = 19.39 * 60 / 30_000  # s, a view forward and backward with its loss and Adam on an A100
RENDER_GAUSSIANS, RENDER_PIXELS = 3.24e6, 1.2e6  # of that view
RENDER_FASTER = 2.4  # an H200's bandwidth over an A100's (2.0 TB/s)
NODE = 8  # GPUs that NVLink joins
FLOAT32_USE = 0.75  # of PEAK_FLOAT32 that large products reach
SHARED = ("weights", "moments of the optimiser, buffers")  # among GPUs by FSDP2
PASSES = 36  # over a million scenes, as many as the samples of RealEstate10K make

PAPER = (
    *(f"{model}/re10k.yaml" for model in ("tokengs", "locus")),
    *(f"{model}/re10k_4096.yaml" for model in ("tokengs", "locus")),
    *(f"{model}/dl3dv.yaml" for model in ("tokengs", "locus")),
    *(f"{model}/dl3dv_4096_{n}views.yaml" for n in (2, 4, 6) for model in ("tokengs", "locus")),
)
OF_MILLION = "locus/dl3dv_4096_4views.yaml"


@dataclass(frozen=True)
class Cost:
    """What training costs. forward, backward, biased: FLOPs of matrix products of a scene, biased
    those of attention with a bias in both. pairs: of query and token that have a bias. saved, once:
    bytes of activations of a scene, and of all. operations: of both passes, launched one by one.
    gaussians: of a layer; layers: that are rendered.
    """

    name: str
    recipe: Recipe
    parameters: int
    forward: float
    backward: float
    biased: float
    pairs: float
    saved: float
    once: float
    operations: int
    gaussians: int
    layers: int

    @cached_property
    def needs(self) -> dict[int, Need]:
        """Of a training on one GPU, by scenes: memory is a line through these two."""
        work: dict[str, Any] = {"device": "cuda", "precision": "bf16"}
        return {n: need_of(self.recipe, workload_of(self.recipe, batch=n, **work)) for n in (1, 2)}

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the images."""
        return image_size(self.recipe)

    @property
    def views(self) -> int:
        """Images that a sample loads."""
        return self.recipe.views.inputs + self.recipe.views.targets

    def network(self, scenes: float, share: float, blocks: bool = False) -> float:
        """Seconds of forward and backward pass and optimiser at a share of PEAK.

        blocks: attention with a bias in float32, as `qgs.components.attention_bias` computes it
        without a kernel.
        """
        flops = self.forward + self.backward - self.biased * blocks
        slow = self.biased * blocks / FLOAT32_USE + self.pairs * BIAS_FLOPS
        computed = scenes * (flops / (share * PEAK) + slow / PEAK_FLOAT32)
        adam = 9 * 4 * self.parameters / (LINK_USE * BANDWIDTH)  # reads and writes of float32
        return max(computed, LAUNCH[share] * self.operations) + adam

    def rendering(self, scenes: float, faster: float = 1.0) -> float:
        """Seconds to render the targets of all layers, forward and backward, after gsplat's own."""
        height, width = self.size
        share = max(self.gaussians / RENDER_GAUSSIANS, height * width / RENDER_PIXELS)
        return scenes * RENDER * share * self.recipe.views.targets * self.layers / faster

    def exchange(self, gpus: int) -> float:
        """Seconds of DDP's all-reduce: within nodes by NVLink, between them each GPU its part."""
        size, nodes = 4 * self.parameters, gpus // NODE
        within = 2 * (NODE - 1) / NODE * size / NVLINK
        between = 2 * (nodes - 1) / nodes * size / NODE / NETWORK
        return (within + between) / LINK_USE

    def step(self, scenes: float, gpus: int, share: float, faster: float) -> float:
        """Seconds of a step; what is exchanged hides behind the backward pass, 0.6 of the network's
        time."""
        network = self.network(scenes, share)
        left = max(0.0, self.exchange(gpus) - 0.6 * network)
        return network + self.rendering(scenes, faster) + left

    def memory(self, scenes: int, gpus: int = 1) -> float:
        """Bytes on a GPU; gpus: that share weights and moments (FSDP2), 1 for DDP.

        What `qgs bench --predict` counts, and DDP's buckets, or the layer that FSDP2 has in whole.
        """
        one, two = self.needs[1], self.needs[2]
        whole = one.total + (scenes - 1) * (two.total - one.total)
        shared = sum(one.step[what] for what in SHARED) * (1 - 1 / gpus)
        return whole - shared + 4 * self.parameters * (0.1 if gpus > 1 else 1)


class Autocast(TorchFunctionMode):
    """What bf16 autocast does on a GPU, for "meta", for which torch has none."""

    LOW = (F.linear, F.conv2d, torch.matmul, torch.bmm, torch.baddbmm)
    HIGH = (F.layer_norm, F.softplus, torch.exp)

    def __torch_function__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Call `func` with tensors of the precision that autocast chooses for it."""
        dtype = torch.bfloat16 if func in self.LOW else torch.float32 if func in self.HIGH else None
        named = kwargs or {}
        if dtype is not None:
            args = [_cast(x, dtype) for x in args]
            named = {name: _cast(x, dtype) for name, x in named.items()}
        return func(*args, **named)


def _cast(value: Any, dtype: torch.dtype) -> Any:
    return value.to(dtype) if isinstance(value, Tensor) and value.is_floating_point() else value


class Operations(TorchDispatchMode):
    """Counts what is launched: all operations but those that only look at memory otherwise."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Count `func` and call it."""
        self.count += not func.is_view and func is not torch.ops.aten.detach.default
        return func(*args, **(kwargs or {}))


class Counter:
    """What the backward pass of a model on "meta" needs, and what attention with a bias reads."""

    def __init__(self, parameters: Iterable[Tensor]) -> None:
        self._own = {id(parameter.untyped_storage()): parameter for parameter in parameters}
        self._saved: dict[int, Tensor] = {}  # tensors, so that ids stay those of their storages
        self.biased = self.pairs = 0.0
        self.operations = Operations()

    def attend(self, q: Tensor, k: Tensor, v: Tensor, attn_mask: None = None) -> Tensor:
        """Attention as the flash kernel runs it."""
        low = [x.to(torch.bfloat16) for x in (q, k, v)]
        return torch.ops.aten._scaled_dot_product_flash_attention(*low)[0]

    def attend_biased(self, q: Tensor, k: Tensor, v: Tensor, bias: AttentionBias) -> Tensor:
        """As `attend`; keeps what the bias reads and lets gradients into it."""
        scenes, heads, queries, width = q.shape
        pairs = scenes * queries * k.shape[2]
        self.pairs += pairs
        self.biased += (4 + 10) * pairs * heads * width  # forward, and the flash kernel's backward
        read = self.keep(bias.queries).sum() + self.keep(bias.tokens).sum()
        return self.attend(q, k, v) + 0 * read.to(torch.bfloat16)

    def keep(self, tensor: Tensor) -> Tensor:
        """A tensor that is saved for the backward pass."""
        self._saved[id(tensor.untyped_storage())] = tensor
        return tensor

    def bytes(self) -> int:
        """Of what was saved, without parameters."""
        saved = (x for key, x in self._saved.items() if key not in self._own)
        return sum(x.untyped_storage().nbytes() for x in saved)


def count(name: str, changes: Sequence[str] = ()) -> Cost:
    """What the training of a recipe costs."""
    recipe = resolve(name, changes)
    model = recipe.build_model("meta").train()
    forward, both, one = run(recipe, model, 1)
    *_, two = run(recipe, model, 2)
    saved = two.bytes() - one.bytes()
    layers = model.supervision.weights()
    queries, each = model.queries.count, recipe.tree["model"]["head"]["gaussians_per_query"]
    return Cost(
        name.removesuffix(".yaml"),
        recipe,
        sum(parameter.numel() for parameter in model.parameters()),
        forward,
        both - forward,
        one.biased,
        one.pairs,
        saved,
        one.bytes() - saved,
        one.operations.count,
        queries * each,
        len(layers),
    )


def image_size(recipe: Recipe) -> tuple[int, int]:
    """(H, W) of the images of a recipe's data."""
    size = recipe.data_config.image_size if recipe.data_config else None
    if size is None:
        raise SystemExit("the recipe has no data.image_size: give a recipe that has data")
    return size


def run(recipe: Recipe, model: QueryGaussianModel, scenes: int) -> tuple[float, float, Counter]:
    """FLOPs of the forward pass, of forward and backward pass, and what was counted besides."""
    photos = posed_photos(scenes, recipe.views.inputs, image_size(recipe), 0).to("meta")
    counter, flops = Counter(model.parameters()), FlopCounterMode(display=False)
    hooks = torch.autograd.graph.saved_tensors_hooks(counter.keep, lambda kept: kept)
    with (
        patch.object(F, "scaled_dot_product_attention", counter.attend),
        patch.object(blocks, "biased_attention", counter.attend_biased),
        flops,
        counter.operations,
        hooks,
    ):
        with Autocast():
            prediction = model(photos)
        forward = flops.get_total_flops()
        found = [x for layer in prediction.layers.values() for _, x in named_tensors(layer)]
        torch.stack([x.sum() for x in found if x.requires_grad]).sum().backward()
    model.zero_grad()
    return forward, flops.get_total_flops(), counter


def check(name: str) -> None:
    """What torch's counter sees of the real attention with a bias, beside what is counted here."""
    recipe = resolve(name)
    model = recipe.build_model("meta").train()
    _, counted, counter = run(recipe, model, 1)
    with patch.object(Counter, "attend_biased", _real):
        _, seen, _ = run(recipe, model, 1)
    of_code = seen - (counted - counter.biased)
    print(
        f"{name}, a scene, forward and backward: attention with a bias takes "
        f"{counter.biased / 1e12:.2f} TFLOP by formula; of the code that runs without a kernel "
        f"torch's counter sees {of_code / 1e12:.2f}"
    )


def _real(_: Counter, *given: Any) -> Tensor:
    with torch._C.DisableTorchFunction():  # which leaves autocast, as it does by itself
        return attention_bias.biased_attention(*given)


def table(header: str, rows: Iterable[Sequence[str]]) -> None:
    """A Markdown table."""
    print(f"\n{header}\n|---" + "|---:" * (header.count("|") - 2) + "|")
    for row in rows:
        print(f"| {' | '.join(row)} |")


def span(low: float, high: float, *, digits: int = 0) -> str:
    """Two numbers, the smaller one first."""
    first, second = (f"{x:,.{digits}f}" for x in sorted((low, high)))
    return first if first == second else f"{first} to {second}"


def print_counts(costs: Sequence[Cost]) -> None:
    """What was counted of a scene."""
    header = (
        "| recipe | parameters, M | forward, TFLOP | forward and backward | of it with a bias | "
        "activations, GB | once, GB | operations | Gaussians x layers |"
    )
    table(
        header,
        (
            (
                f"`{cost.name}`",
                f"{cost.parameters / 1e6:.1f}",
                f"{cost.forward / 1e12:.2f}",
                f"{(cost.forward + cost.backward) / 1e12:.2f}",
                f"{cost.biased / 1e12:.2f}",
                f"{cost.saved / 1e9:.2f}",
                f"{cost.once / 1e9:.2f}",
                f"{cost.operations:,}",
                f"{cost.gaussians:,} x {cost.layers}",
            )
            for cost in costs
        ),
    )


def trainings(costs: Sequence[Cost]) -> Iterator[tuple[Cost, str, int, float, float]]:
    """Trainings on 8 and 64 GPUs: cost, name, GPUs, scenes a GPU, samples in all."""
    for gpus, batch in ((8, 16), (64, 64)):
        for cost in costs:
            config = cost.recipe.training
            assert config.steps is not None
            samples = config.steps * config.batch_size
            yield cost, f"`{cost.name}`", gpus, batch / gpus, samples
    million = [cost for cost in costs if f"{cost.name}.yaml" == OF_MILLION]
    for gpus in (8, 64):
        for cost in million:
            yield cost, "a million scenes", gpus, 8, 1e6 * PASSES


def print_times(costs: Sequence[Cost]) -> None:
    """Time of a step and of a training, and images that it asks for."""
    header = (
        "| training | GPUs | scenes a step | steps, k | network, ms | in blocks, ms | "
        "renderer, ms | exchange, ms | step, ms | hours | images/s |"
    )
    rows = []
    for cost, name, gpus, scenes, samples in trainings(costs):
        ends = ((UTILISATION[0], 1.0), (UTILISATION[1], RENDER_FASTER))
        steps = samples / (scenes * gpus)
        step = [cost.step(scenes, gpus, *end) for end in ends]
        slow = [cost.network(scenes, share, True) for share, _ in ends]
        hours = [steps * x / 3600 for x in step]
        rows.append(
            (
                name,
                str(gpus),
                f"{scenes * gpus:g}",
                f"{steps / 1e3:,.1f}",
                span(*(1e3 * cost.network(scenes, share) for share, _ in ends)),
                span(*(1e3 * x for x in slow)) if cost.biased else "",
                span(*(1e3 * cost.rendering(scenes, faster) for _, faster in ends)),
                f"{1e3 * cost.exchange(gpus):.1f}",
                span(*(1e3 * x for x in step)),
                span(*hours, digits=2 if max(hours) < 1 else 1),
                span(*(cost.views * scenes * gpus / x for x in step)),
            )
        )
    table(header, rows)


def print_memory(costs: Sequence[Cost]) -> None:
    """Memory of a GPU and bytes that it sends in a step."""
    header = (
        "| recipe | DDP, GB at 2 scenes | 8 | 16 | FSDP2 on 8, 2 scenes | most scenes, DDP | "
        "DDP sends, GB | FSDP2 sends, GB |"
    )
    rows = []
    for cost in costs:
        each = cost.memory(2) - cost.memory(1)
        size = 4 * cost.parameters * (NODE - 1) / NODE / 1e9
        rows.append(
            (
                f"`{cost.name}`",
                *(f"{cost.memory(scenes) / 1e9:.0f}" for scenes in (2, 8, 16)),
                f"{cost.memory(2, NODE) / 1e9:.0f}",
                f"{1 + (0.9 * MEMORY - cost.memory(1)) // each:.0f}",
                f"{2 * size:.2f}",
                f"{3 * size:.2f}",
            )
        )
    table(header, rows)


def print_growth() -> None:
    """Activations and FLOPs where views and queries grow beyond the paper's."""
    rows = []
    for views, queries in ((4, 4096), (8, 8192), (16, 8192), (32, 16384)):
        changes = [f"views.inputs={views}", f"model.queries.count={queries}"]
        cost = count(OF_MILLION, changes)
        rows.append(
            (
                f"{views} x {queries:,}",
                f"{(cost.forward + cost.backward) / 1e12:,.0f}",
                f"{cost.saved / 1e9:.1f}",
                f"{cost.memory(1) / 1e9:.0f}",
                span(*(cost.network(1, share) for share in UTILISATION), digits=2),
            )
        )
    table("| views x queries | TFLOP a scene | activations, GB | GB on a GPU | s a scene |", rows)


def main() -> None:
    """Print the tables of docs/scale.md."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("recipes", nargs="*", metavar="RECIPE", default=PAPER)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    if options.check:
        return check(OF_MILLION)
    costs = [count(name) for name in options.recipes]
    print_counts(costs)
    print_times(costs)
    print_memory(costs)
    print_growth()
    return None


if __name__ == "__main__":
    main()
