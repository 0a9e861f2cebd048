"""Rounds of feedback: a model's passes against calls of its parts, training, traces, refusals."""

from pathlib import Path
from typing import Any

import pytest
import torch
from commands import run_qgs
from refusals import refused

import qgs
from qgs.composer import resolve
from qgs.engine.initial import initialise
from qgs.engine.training_pass import TrainingPass
from qgs.io.checkpoint import save
from qgs.io.tensors import CheckpointError
from qgs.types import Cameras, Photos, Views

RECIPES = Path(__file__).parents[3] / "recipes"
STARTS = {"type": "landmark/observed", "near": 0.5, "far": 4.0, "cells": 4}
LAYER = {
    "cross_attention": {"type": "locus/ray_biased"},
    "self_attention": {"type": "landmark/neighbours", "count": 4},
    "refinement": {"type": "landmark/refine", "zero_init": True},
}


def recipe(**model: Any) -> dict[str, Any]:
    parts = {
        "width": 32,
        "heads": 2,
        "encoder": {"patch_size": 8, "depth": 1},
        "queries": STARTS | {"count": None},
        "decoder": {"depth": 3, "layer_scale": 0.3, **LAYER},
        "feedback": {"type": "landmark/rendered", "rounds": 2, "layers": 2},
        "head": {"type": "landmark/colored", "opacity_bias": 1.0},
        "centers": {"type": "landmark/footprint"},
        "supervision": {"layers": [1, 3]},
        "renderer": {"type": "qgs/torch"},
    }
    losses = {"photometric": {"type": "qgs/photometric"}}
    return {"recipe": 1, "plugins": ["landmark", "locus"], "model": parts | model, "losses": losses}


def views(count: int = 2, size: tuple[int, int] = (32, 32)) -> Views:
    """Smooth noise, from cameras side by side."""
    coarse = torch.rand(count, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    images = torch.nn.functional.interpolate(coarse, size, mode="bilinear")[None]
    c2w = torch.eye(4).repeat(1, count, 1, 1)
    c2w[0, :, 0, 3] = 0.1 * torch.arange(count)
    lens = torch.tensor([size[1], size[1], size[1] / 2, size[0] / 2]).expand(1, count, 4)
    return Views(images, Cameras(c2w, lens, size))


def test_rounds_run_the_last_layers_on_the_first_memory() -> None:
    model, given = resolve(recipe()).build_model().eval(), views()
    with torch.no_grad():
        found = model(given, layers=[1])
        memory = model.encoder(given)
        state, after = model.queries(memory, given), memory

        def run(index: int) -> None:
            nonlocal state, after
            state, after = model.decoder[index](state, after)
            state = model.refinements[model.refinement_of[index]](state)

        for index in range(3):
            run(index)
        for _ in range(2):
            small = model.feedback.compared(given)
            rendering = model.render(model.decode(state), small.cameras)
            state, after = model.feedback(state, memory, rendering, small)
            run(1)
            run(2)
    assert list(found.layers) == [1, 3, 5, 7]
    assert model.depth == 7
    torch.testing.assert_close(found.state.features, state.features)
    torch.testing.assert_close(found.gaussians.means, model.decode(state).means)
    before, last = (found.layers[n].gaussians.means for n in (3, 7))
    assert not torch.allclose(before, last)


@pytest.mark.parametrize("rounds", [0, 1, 4])
def test_a_built_model_makes_other_numbers_of_rounds(rounds: int) -> None:
    model, given = resolve(recipe()).build_model().eval(), views()
    model.feedback.rounds = rounds
    with torch.no_grad():
        assert list(model(given).layers) == [3 + 2 * n for n in range(rounds + 1)]
        with pytest.raises(ValueError, match=f"layers 1..{3 + 2 * rounds}"):
            model(given, layers=[4 + 2 * rounds])


def test_an_evaluation_sets_the_number_of_rounds(tmp_path: Path) -> None:
    """The scores of N rounds are those of a model whose recipe has N."""
    words = ("plugins=[landmark, locus, rooms]", "data.type=rooms/procedural")
    fewer = ("data.image_size=[32, 32]", "views.targets=2", "evaluation.scenes=2")
    scores: dict[tuple[int, int], str] = {}
    for made, asked in ((2, 2), (2, 1), (1, 1)):
        feedback = {"type": "landmark/rendered", "rounds": made, "layers": 2}
        torch.manual_seed(0)
        model = resolve(recipe(feedback=feedback), (*words, *fewer)).build_model()
        file, out = tmp_path / f"{made}.safetensors", tmp_path / f"{made}{asked}"
        if not file.exists():
            qgs.save(model, file)
        result = run_qgs("eval", file, "--set", f"model.feedback.rounds={asked}", "--out", out)
        assert result.exit_code == 0, result.output
        scores[made, asked] = (out / "scenes.csv").read_text()
    assert scores[2, 1] == scores[1, 1] != scores[2, 2]
    refusal = run_qgs("eval", file, "--set", "model.feedback.rounds_more=1").exception
    assert "would change the trained model" in str(refusal)


def test_training_supervises_every_round_it_draws() -> None:
    """The total is that of the layers and of the ends of rounds, later ones weighing more."""
    built = resolve(recipe())
    model, given, ends = built.build_model().train(), views(), set()
    passes = TrainingPass.of(built, model)
    for seed in range(8):
        torch.manual_seed(seed)
        outcome = passes(given, given)
        torch.manual_seed(seed)
        prediction = model(given)
        numbers = sorted(prediction.layers)
        ends.add(numbers[-1])
        expected = torch.zeros(())
        for rank, number in enumerate(numbers, start=1):
            layer = prediction.layers[number]
            rendering = model.render(layer.gaussians, given.cameras)
            terms = passes.losses["photometric"](layer, rendering, given, given)
            expected = expected + rank / sum(range(len(numbers) + 1)) * sum(terms.values())
        torch.testing.assert_close(outcome.total, expected)
    assert ends == {5, 7}
    outcome.total.backward()
    assert not [name for name, x in model.named_parameters() if x.grad is None]


def test_rounds_are_traced_as_layers_are() -> None:
    model, given = resolve(recipe()).build_model().eval(), views()
    with torch.no_grad(), qgs.trace(model, queries=[1, 3]) as trace:
        found = model(given, layers=range(1, 8))
    assert list(trace.layers) == [1, 2, 3, 4, 5, 6, 7]
    for number, layer in trace.layers.items():
        assert layer.after is not None
        torch.testing.assert_close(
            layer.after.features, found.layers[number].state.features[:, [1, 3]]
        )
        assert layer.cross_attention is not None
    first, again = (trace.layers[n].cross_attention for n in (2, 4))
    assert first is not None
    assert again is not None
    assert not torch.allclose(first.weights, again.weights)


def test_rounds_need_cameras() -> None:
    model = resolve(recipe()).build_model().eval()
    with pytest.raises(ValueError, match="RenderedFeedback"):
        model(Photos(views().images))


@pytest.mark.parametrize(
    ("model", "option"),
    [
        ({"feedback": {"type": "landmark/rendered", "layers": 4}}, "model.feedback.layers"),
        ({"feedback": {"type": "landmark/rendered", "least": 3}}, "model.feedback.least"),
        ({"head": {"type": "landmark/colored", "gaussians_per_query": 2}}, "model.head"),
        ({"centers": {"type": "landmark/footprint", "radius_min": 0.1}}, "model.centers"),
        ({"queries": STARTS | {"cells": None}}, "model.head"),
        ({"queries": STARTS | {"far": 0.1}}, "model.queries.far"),
    ],
)
def test_what_cannot_work_is_refused(model: dict[str, Any], option: str) -> None:
    assert refused(recipe(**model)).option == option


@pytest.mark.parametrize("count", [2, 5])
def test_a_number_of_anchors_is_that_for_any_number_of_photos(count: int) -> None:
    model = resolve(recipe(queries=STARTS | {"count": 20})).build_model().eval()
    with torch.no_grad():
        assert model(views(count)).gaussians.count == 80


def test_it_learns() -> None:
    torch.manual_seed(0)
    model, given, losses = resolve(recipe()).build_model().train(), views(size=(16, 16)), []
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    for _ in range(20):
        rendered = model.render(model(given).gaussians, given.cameras).rgb
        loss = (rendered - given.images).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0], losses


def test_the_shipped_recipe_has_as_many_gaussians_as_the_others() -> None:
    counts = {}
    for name in ("locus", "landmark"):
        model = qgs.compose(RECIPES / "tiny" / f"{name}.yaml", device="meta")
        counts[name] = sum(parameter.numel() for parameter in model.parameters())
    assert abs(counts["landmark"] / counts["locus"] - 1) < 0.1


def test_a_model_without_rounds_starts_one_with_rounds(tmp_path: Path) -> None:
    """They repeat its layers: what they add to keys, values and features is 0 at first."""
    plain = resolve(recipe(feedback={"type": "qgs/none"})).build_model()
    save(plain, tmp_path / "plain.safetensors")
    grown = resolve(recipe() | {"init_from": str(tmp_path / "plain.safetensors")})
    model = grown.build_model().eval()
    said = initialise(model, grown)
    assert "feedback.marker: none -> (32,)" in said
    assert "learned with model.feedback.type: qgs/none (here landmark/rendered)" in said
    weights = model.state_dict()
    assert all(torch.equal(weights[name], values) for name, values in plain.state_dict().items())
    given = views()
    with torch.no_grad():
        memory = model.encoder(given)
        state = model.queries(memory, given)
        for index in (0, 1, 2, 1, 2, 1, 2):
            state, _ = model.decoder[index](state, memory)
            state = model.refinements[model.refinement_of[index]](state)
        torch.testing.assert_close(model(given).state.features, state.features)


def test_rounds_go_on_from_rounds(tmp_path: Path) -> None:
    first = resolve(recipe())
    learned = first.build_model()
    save(learned, tmp_path / "rounds.safetensors")
    more = resolve(
        recipe(feedback={"type": "landmark/rendered", "rounds": 3})
        | {"init_from": str(tmp_path / "rounds.safetensors")}
    )
    model = more.build_model()
    initialise(model, more)
    assert all(map(torch.equal, model.state_dict().values(), learned.state_dict().values()))


def test_rounds_of_another_kind_are_refused(tmp_path: Path) -> None:
    save(resolve(recipe()).build_model(), tmp_path / "rounds.safetensors")
    start = {"init_from": str(tmp_path / "rounds.safetensors")}
    for feedback in ({"type": "qgs/none"}, {"type": "landmark/rendered", "cells": 1}):
        other = resolve(recipe(feedback=feedback) | start)
        with pytest.raises(CheckpointError, match=r"feedback\.embedding\.weight"):
            initialise(other.build_model(), other)
