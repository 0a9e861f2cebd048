"""Recipes: published sizes, what is refused, and trainings of small ones."""

import pytest
import torch
import yaml
from globalsplat_inputs import SMALL, TINY
from training_runs import first_batch, run

import qgs
from qgs.recipe import RecipeError, resolve
from qgs.train.training_pass import TrainingPass

PUBLISHED = "globalsplat/re10k.yaml"


def test_parameters_of_the_published_size():
    """By arithmetic: 512 wide, 8 heads, 2057 tokens, four rounds of two blocks, 16 candidates."""
    model = qgs.compose(PUBLISHED, device="meta")
    found = [
        sum(p.numel() for p in part.parameters())
        for part in (model.encoder, model.queries, model.decoder, model.head)
    ]
    assert found == [227_712, 1_580_544, 4 * 20_502_528, 510_944]
    assert sum(found) == 84_329_312
    assert (len(model.queries.slots), len(model.queries.extra)) == (2048, 9)


LEVELS = """
{0: 0, 9999: 0, 10000: 0, 10500: 0.25, 12000: 1, 15000: 1, 21500: 1.75, 22000: 2, 51000: 2.5,
 52000: 3, 219999: 3}
"""


def test_published_training():
    recipe = resolve(PUBLISHED)
    (schedules,) = [part.schedules for part in recipe.parts.values() if part.schedules]
    levels = yaml.safe_load(LEVELS)
    assert {step: schedules["level"].number(step) for step in levels} == levels
    optimizer = recipe.tree["optimizer"]
    assert optimizer["initial_divisor"] * optimizer["final_divisor"] == 50
    assert optimizer["warmup"] == 0.03 * recipe.training.steps


REFUSED = """
model.decoder.layer.memory_width=null: 96 float32
model.encoder.rgb_width=32: 64 float32
model.queries={type: qgs/latent, count: 8}: globalsplat.texture
model.decoder.layer={type: qgs/cross_self_mlp}: memory.keys
model.decoder.cross_attention={type: qgs/content}: cross_attention
model.head.level=5: model.head.level
model.head.candidates=12: must be a power of two
model.head.scale_min=0.1: model.head.scale_min
model.head.level={schedule: linear, values: [0, 4.5], at: [1, 9]}: model.head.level
model.queries.extra=256: model.queries.extra
data.image_size=[60, 64]: patch_size
objective={type: globalsplat/two_passes}: at least 3 input views, got 2
"""


def test_what_cannot_work_is_refused():
    for line in REFUSED.strip().splitlines():
        override, _, named = line.rpartition(": ")
        with pytest.raises(RecipeError) as caught:
            resolve(TINY, [override])
        assert named in str(caught.value)


def test_it_learns():
    """One batch by heart, with every loss."""
    recipe = resolve(TINY, [*SMALL, "losses.regularisers={type: globalsplat/regularisers}"])
    judged = TrainingPass(recipe, recipe.build_model().train())
    batch = first_batch(recipe)
    optimizer = torch.optim.AdamW(judged.parameters(), 3e-3)
    errors = []
    for _ in range(20):
        total = judged(batch.inputs, batch.targets).total
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        errors.append(total.item())
    assert errors[-1] < 0.4 * errors[0]


def test_two_passes_train_and_their_terms_are_recorded(tmp_path):
    growing = "model.head.level={schedule: steps, values: [0, 0.5, 1, 3], at: [1, 2, 4]}"
    two = ("objective={type: globalsplat/two_passes}", "views.inputs=4", growing)
    brief = ("training.steps=6", "training.seconds=null", "optimizer.warmup=2")
    recipe = resolve(TINY, [*SMALL, *two, *brief, "evaluation.scenes=2"])
    folder = run(recipe, tmp_path / "run").folder
    history = folder.history()
    assert len(history) > 1
    for record in history:
        terms = ("mse", "frustum", "alpha_consistency", "depth_consistency")
        assert all(record[term] > 0 for term in terms)
    model = qgs.load(folder.checkpoint)
    assert model.head.gaussians_per_query == 8  # those of the last step
    assert qgs.compose(TINY, overrides=[growing]).head.gaussians_per_query == 1  # of the first one
