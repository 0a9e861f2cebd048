"""Whole models: recipes, sizes as published, and parts of LocusGS beside C3G's."""

import pytest
import torch
from odd_views import odd_views
from qgs_dev import Case
from qgs_dev.checks.fields import run_training_step
from qgs_zoo.c3g.joint import JointLayer
from refusals import refused

from qgs.containers import named_tensors
from qgs.contracts.schedule import follow
from qgs.recipe import resolve

TINY = "tiny/c3g.yaml"
NARROW = ("model.width=16", "model.heads=2", "model.queries.count=6")
SHALLOW = ("model.decoder.depth=2", "model.supervision.layers=[2]")
SMALL = (
    *NARROW,
    *SHALLOW,
    "plugins=[c3g, rooms, locus, tokengs2026]",
    "optimizer.parts={}",
    "model.head.gaussians_per_query=1",
)
ANCHORED = "model.queries={type: locus/anchored, count: 6}"
CASE = Case(JointLayer.Config())


def size(module):
    return sum(p.numel() for p in module.parameters())


def test_the_published_recipe():
    """Its sizes, a Gaussian for each query, and a dilation divided by 3 every 1000 steps."""
    recipe = resolve("c3g/re10k.yaml")
    assert recipe.training.judge_inputs
    model = recipe.build_model("meta")
    trained = 71_368_718  # beside the backbone, for which a ViT stands
    assert (size(model.encoder), size(model)) == (314_199_296, 314_199_296 + trained)
    assert (model.queries.count, model.head.gaussians_per_query) == (2048, 1)
    found = {}
    for step in (0, 999, 1000, 1001, 2500, 3000, 3999, 4000, 449_999):
        follow([model.renderer], step)
        found[step] = model.renderer.config.dilation
    assert found == pytest.approx({step: max(0.3, 10 / 3 ** (step // 1000)) for step in found})


def ran(*overrides):
    recipe = resolve(TINY, [*SMALL, *overrides])
    run_training_step(recipe, CASE)
    return recipe.build_model()


def test_anchors_move_and_place_gaussians_beside_joint_attention():
    model = ran(
        ANCHORED,
        "model.decoder.refinement={type: locus/refine}",
        "model.centers={type: locus/radius_scaled}",
        "model.supervision.layers=[1, 2]",
        "losses.anchors={type: locus/anchor_visibility}",
    )
    first, last = model(odd_views()).layers.values()
    assert not torch.equal(first.state["anchor.center"], last.state["anchor.center"])
    off = last.gaussians.means - last.state["anchor.center"]
    assert off.norm(dim=-1).max() < 5


def test_what_stands_in_another_layer_is_refused():
    for slot, part in {
        "cross_attention": "locus/ray_biased",
        "self_attention": "locus/anchor_aware",
        "feed_forward": "qgs/mlp",
    }.items():
        problem = refused(TINY, [*SMALL, ANCHORED, f"model.decoder.{slot}={{type: {part}}}"])
        assert problem.reason.startswith("`c3g/joint` ")
        assert f"has no slot `{slot}`" in problem.reason
        assert problem.fix.startswith("remove it")


def test_tokens_of_another_width_are_refused_and_of_the_models_run():
    wide = "model.encoder={type: tokengs2026/multiscale_vit, depth: 2, blocks: [1, 2]}"
    problem = refused(TINY, [*SMALL, wide])
    assert problem.option == "model.encoder"
    assert "`c3g/joint` reads memory.features as D float32" in problem.reason
    assert "writes it as 2*D float32" in problem.reason
    ran(wide.replace("[1, 2]", "[2]"))
    latents = "depth: 1, blocks: [1], latents: 5, latent_depth: 1"
    ran(f"model.encoder={{type: tokengs2026/latent_bottleneck, {latents}}}")


def test_layers_of_both_kinds_may_alternate():
    rays = "cross_attention: {type: locus/ray_biased}"
    second = f"{{layer: {{type: qgs/cross_self_mlp}}, {rays}}}"
    model = ran(ANCHORED, f"model.decoder.layers={{1: {second}}}")
    assert [type(layer).__name__ for layer in model.decoder] == ["JointLayer", "CrossSelfMlp"]


def test_every_parameter_that_trains_is_read():
    """Processes that train together wait for a gradient of each of them."""
    for name, side in (("tiny/c3g", 16), ("c3g/re10k", 28)):
        recipe = resolve(f"{name}.yaml", [*NARROW, *SHALLOW])
        model = recipe.build_model().train()
        gaussians = model(odd_views(2, side, side)).gaussians
        torch.stack([x.sum() for _, x in named_tensors(gaussians)]).sum().backward()
        unread = {name for name, p in model.named_parameters() if p.grad is None}
        factors = recipe.rate_factors(model).items()
        assert unread == {name for name, factor in factors if factor == 0}, name
        assert len(unread) == 4, name
