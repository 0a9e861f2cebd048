"""`init_from`: queries grow and shrink by the published rule, all else is taken as it is."""

import torch
from safetensors.torch import load_file
from tables import assert_equal, must_refuse, text_console
from torch.testing import assert_close
from training_runs import tiny

from qgs.checkpoint.model_file import save
from qgs.checkpoint.tensors import CheckpointError
from qgs.recipe import resolve
from qgs.train.initial import initialise
from qgs.train.training import train

COUNT = 24
GROWTH_NOISE = 0.01  # LocusGS release


def started(recipe):
    model = recipe.build_model()
    return model, initialise(model, recipe)


def learned(name, *options):
    """A tiny recipe that starts from a checkpoint of another seed."""
    path = f"{name}.safetensors"
    save(tiny(name, "seed=7").build_model(), path)
    return tiny(name, f"init_from={path}", *options)


def test_old_queries_stay_and_new_ones_are_noisy_copies():
    for count in (10, 25, 96):
        recipe = learned("locus", f"model.queries.count={count}")
        model, told = started(recipe)
        old = load_file(recipe.tree["init_from"])
        for parameter, now in model.state_dict().items():
            before = old[parameter]
            if not parameter.startswith("queries."):
                assert_equal(now, before)
                continue
            assert len(now) == count
            assert_equal(now[:COUNT], before[:count])
            shapes = f"{tuple(before.shape)} -> {tuple(now.shape)}"
            change = f"{parameter}: {shapes}: the first queries are kept"
            assert any(line.startswith(change) for line in told)
            if count > COUNT:
                noise = (now[COUNT:] - before[torch.arange(COUNT, count) % COUNT]) / GROWTH_NOISE
                assert noise.abs().max() < 6
                assert noise.abs().min() > 0
                if noise.numel() > 1000:
                    assert abs(noise.std() - 1) <= 0.1
                    assert abs(noise.mean()) <= 0.1


def test_weights_that_do_not_fit_are_refused():
    recipe = learned("tokengs", "model.head.gaussians_per_query=2")
    reason = r"model\.head\.gaussians_per_query: 4 \(here 2\)"
    must_refuse(reason, started, recipe, kind=CheckpointError)


def test_the_recipes_seed_decides_the_noise():
    def features(seed):
        torch.rand(seed)  # the global random state plays no part
        model, _ = started(learned("tokengs", "model.queries.count=30", f"seed={seed}"))
        return model.queries.features

    assert_equal(features(1), features(1))
    assert not torch.equal(features(1), features(2))


def test_larger_patches_give_the_tokens_of_coarser_images():
    recipe = learned("tokengs", "model.encoder.patch_size=16", "data.image_size=[64, 64]")
    model, told = started(recipe)
    coarse, _ = started(
        resolve(recipe.tree, ["model.encoder.patch_size=8", "data.image_size=[32, 32]"])
    )
    images = torch.rand(2, 3, 32, 32)
    found = model.encoder.rgb_embedding(images.repeat_interleave(2, -1).repeat_interleave(2, -2))
    assert_close(found, coarse.encoder.rgb_embedding(images))
    assert "encoder.ray_embedding.proj.weight: (32, 6, 8, 8) -> (32, 6, 16, 16)" in told


def test_training_starts_from_a_run(trained_run):
    start = f"init_from={trained_run.folder.path}"
    still = "optimizer={learning_rate: 1.0e-9, weight_decay: 0.0}"
    console = text_console()
    grown = tiny("locus", "model.queries.count=32", start, still)
    result = train(grown, "run", device="cpu", console=console)
    before, after = (r.model.queries.center for r in (trained_run, result))
    assert_equal(after[:COUNT], before, atol=1e-6)
    assert "queries.center: (24, 3) -> (32, 3)" in console.file.getvalue()
