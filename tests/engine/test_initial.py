"""`init_from`: queries grow and shrink by the published rule, all else is taken as it is."""

from io import StringIO
from pathlib import Path

import pytest
import torch
from rich.console import Console
from safetensors.torch import load_file
from torch import Tensor
from training_runs import Tiny

from qgs.composer import Recipe, resolve
from qgs.engine.initial import initialise
from qgs.engine.training import train
from qgs.io.checkpoint import save
from qgs.io.tensors import CheckpointError
from qgs.model import QueryGaussianModel

COUNT = 24
GROWTH_NOISE = 0.01  # LocusGS release
PER_QUERY = {"tokengs": ["features"], "locus": ["features", "center", "raw_radius"]}


def started(recipe: Recipe) -> tuple[QueryGaussianModel, list[str]]:
    model = recipe.build_model()
    return model, initialise(model, recipe)


@pytest.fixture
def learned(tiny: Tiny, tmp_path: Path) -> Tiny:
    """`learned("locus", "a.b=c")`: that tiny model, from a checkpoint of another seed."""

    def make(name: str, *options: str, of: str = "") -> Recipe:
        path = tmp_path / f"{of or name}.safetensors"
        save(tiny(of or name, "seed=7").build_model(), path)
        return tiny(name, f"init_from={path}", *options)

    return make


def old_weights(recipe: Recipe) -> dict[str, Tensor]:
    return load_file(recipe.tree["init_from"])


@pytest.mark.parametrize("name", ["tokengs", "locus"])
@pytest.mark.parametrize("count", [25, 60, 96])
def test_old_queries_stay_and_new_ones_are_noisy_copies(
    learned: Tiny, name: str, count: int
) -> None:
    recipe = learned(name, f"model.queries.count={count}")
    model, told = started(recipe)
    old = old_weights(recipe)
    copied = torch.arange(COUNT, count) % COUNT
    for parameter in PER_QUERY[name]:
        before = old[f"queries.{parameter}"]
        after = model.queries.get_parameter(parameter).detach()
        assert len(after) == count
        assert torch.equal(after[:COUNT], before)
        noise = (after[COUNT:] - before[copied]) / GROWTH_NOISE
        assert noise.abs().max() < 6
        assert noise.abs().min() > 0
        if noise.numel() > 1000:
            assert noise.std() == pytest.approx(1, abs=0.1)
            assert noise.mean() == pytest.approx(0, abs=0.1)
        line = (
            f"queries.{parameter}: {COUNT} -> {count}, {COUNT} kept, {count - COUNT} noisy copies"
        )
        assert sum(one.startswith(line) for one in told) == 1
    assert len(told) == 1 + len(PER_QUERY[name])
    rest = {key: t for key, t in model.state_dict().items() if not key.startswith("queries.")}
    assert rest
    assert all(torch.equal(tensor, old[key]) for key, tensor in rest.items())


@pytest.mark.parametrize("name", ["tokengs", "locus"])
def test_shrinking_keeps_the_first(learned: Tiny, name: str) -> None:
    recipe = learned(name, "model.queries.count=10")
    model, told = started(recipe)
    for parameter in PER_QUERY[name]:
        after = model.queries.get_parameter(parameter)
        assert torch.equal(after, old_weights(recipe)[f"queries.{parameter}"][:10])
    assert "queries.features: 24 -> 10, the first are kept" in told


def test_weights_that_do_not_fit_are_refused(learned: Tiny) -> None:
    recipe = learned("tokengs", "model.head.gaussians_per_query=2")
    with pytest.raises(CheckpointError) as caught:
        started(recipe)
    assert f"init_from: {recipe.tree['init_from']} does not fit" in str(caught.value)
    assert "model.head.gaussians_per_query: 4 (here 2)" in str(caught.value)


def test_the_recipes_seed_decides_the_noise(learned: Tiny) -> None:
    def features(seed: int) -> torch.Tensor:
        torch.rand(seed)  # the global random state plays no part
        model, _ = started(learned("tokengs", "model.queries.count=30", f"seed={seed}"))
        return model.queries.get_parameter("features").detach()

    assert torch.equal(features(1), features(1))
    assert not torch.equal(features(1), features(2))
    assert torch.equal(features(1)[:COUNT], features(2)[:COUNT])


def test_larger_patches_give_the_tokens_of_coarser_images(learned: Tiny) -> None:
    recipe = learned("tokengs", "model.encoder.patch_size=16", "data.image_size=[64, 64]")
    model, told = started(recipe)
    coarse = resolve(recipe.tree, ["model.encoder.patch_size=8", "data.image_size=[32, 32]"])
    images = torch.rand(1, 2, 3, 32, 32)
    fine = images.repeat_interleave(2, -1).repeat_interleave(2, -2)
    tokens = model.encoder.rgb_embedding(fine[0])
    assert torch.allclose(tokens, started(coarse)[0].encoder.rgb_embedding(images[0]), atol=1e-5)
    name = "encoder.ray_embedding.proj.weight"
    assert f"{name}: (32, 6, 8, 8) -> (32, 6, 16, 16)" in told


def test_training_starts_from_a_run(tiny: Tiny, tmp_path: Path) -> None:
    base = train(tiny("locus"), tmp_path / "base", device="cpu")
    still = ("optimizer.learning_rate=1e-9", "optimizer.weight_decay=0.0")
    grown = tiny("locus", "model.queries.count=32", f"init_from={tmp_path / 'base'}", *still)
    console = Console(file=StringIO(), width=300)
    result = train(grown, tmp_path / "grown", device="cpu", console=console)
    before = base.model.queries.get_parameter("center")
    after = result.model.queries.get_parameter("center")
    torch.testing.assert_close(after[:COUNT], before, rtol=0, atol=1e-6)
    assert isinstance(console.file, StringIO)
    assert "queries.center: 24 -> 32" in console.file.getvalue()
