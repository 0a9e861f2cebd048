"""Rounds of feedback: a model's passes against calls of its parts, training, traces, refusals."""

import pytest
import torch
import yaml
from commands import done
from odd_views import odd_views
from tables import assert_equal, must_refuse
from torch.testing import assert_close

import qgs
from qgs.checkpoint.model_file import save
from qgs.checkpoint.tensors import CheckpointError
from qgs.recipe import resolve
from qgs.train.initial import initialise
from qgs.train.training_pass import TrainingPass

RECIPE = yaml.safe_load("""
recipe: 1
plugins: [landmark, locus]
model:
  width: 32
  heads: 2
  encoder: {patch_size: 8, depth: 1}
  queries: {type: landmark/observed, count: null, near: 0.5, far: 4.0, cells: 4}
  decoder:
    depth: 3
    layer_scale: 0.3
    cross_attention: {type: locus/ray_biased}
    self_attention: {type: landmark/neighbours, count: 4}
    refinement: {type: landmark/refine, zero_init: true}
  feedback: {type: landmark/rendered, rounds: 2, layers: 2}
  head: {type: landmark/colored, opacity_bias: 1.0}
  centers: {type: landmark/footprint}
  supervision: {layers: [1, 3]}
  renderer: {type: qgs/torch}
losses: {photometric: {type: qgs/photometric}}
""")
NO_ROUNDS = "model.feedback={type: qgs/none}"


def built(*overrides):
    return resolve(RECIPE, overrides).build_model().eval()


def views(count=2, side=32):
    return odd_views(count, side, side, scenes=1)


def run(model, layers, state, memory):
    """The state and the memory after these layers."""
    for index in layers:
        state, memory = model.decoder[index](state, memory)
        state = model.refinements[model.refinement_of[index]](state)
    return state, memory


GRADIENT = "model.feedback={type: landmark/gradient, rounds: 2, layers: 2, steps: 1}"
KINDS = pytest.mark.parametrize("kind", [(), (GRADIENT,)])


@KINDS
@torch.no_grad()
def test_rounds_run_the_last_layers_on_the_first_memory(kind):
    model = built(*kind)
    given = views()
    found = model(given, layers=[1])
    memory = after = model.encoder(given)
    state = model.queries(memory, given)
    state, after = run(model, (0, 1, 2), state, after)
    for _ in range(2):
        state, after = model.feedback(state, memory, given, model.decode, model.render)
        state, after = run(model, (1, 2), state, after)
    assert list(found.layers) == [1, 3, 5, 7]
    assert model.depth == 7
    assert_close(found.state.features, state.features)
    assert_close(found.gaussians.means, model.decode(state).means)
    assert not torch.allclose(found.layers[3].gaussians.means, found.gaussians.means)


@KINDS
def test_an_evaluation_sets_the_number_of_rounds(tmp_path, kind):
    """The scores of N rounds are those of a model whose recipe has N."""
    rooms = (
        "plugins=[landmark, locus, rooms]",
        "data={type: rooms/procedural, image_size: [16, 16]}",
        "views.targets=2",
        "evaluation.scenes=1",
    )

    def scores(made, asked):
        torch.manual_seed(0)
        file = tmp_path / f"{made}.safetensors"
        out = tmp_path / f"{made}{asked}"
        qgs.save(built(*rooms, *kind, f"model.feedback.rounds={made}"), file)
        done(f"eval {file} --set model.feedback.rounds={asked} --out {out}")
        return (out / "scenes.csv").read_text()

    assert scores(2, 1) == scores(1, 1) != scores(2, 2)


@KINDS
def test_training_supervises_every_round_it_draws_and_learns(kind):
    """The total is that of the layers and of the ends of rounds, later ones weighing more."""
    recipe = resolve(RECIPE, kind)
    model = recipe.build_model().train()
    given = views(side=16)
    ends = set()
    passes = TrainingPass(recipe, model)
    for seed in range(3):
        torch.manual_seed(seed)
        outcome = passes(given, given)
        torch.manual_seed(seed)
        layers = sorted(model(given).layers.items())
        ends.add(layers[-1][0])
        expected = torch.zeros(())
        for rank, (_, layer) in enumerate(layers, start=1):
            rendering = model.render(layer.gaussians, given.cameras)
            terms = passes.losses["photometric"](layer, rendering, given, given)
            expected = expected + rank * sum(terms.values())
        assert_close(outcome.total, expected / sum(range(len(layers) + 1)))
    assert ends == {5, 7}
    outcome.total.backward()
    torch.optim.Adam(model.parameters(), 0.001).step()
    torch.manual_seed(seed)
    assert passes(given, given).total < outcome.total


@torch.no_grad()
def test_rounds_are_traced_as_layers_are():
    model = built()
    given = views()
    with qgs.trace(model, queries=[1, 3]) as trace:
        found = model(given, layers=range(1, 8))
    after = {number: layer.after.features for number, layer in trace.layers.items()}
    assert_close(after, {n: layer.state.features[:, [1, 3]] for n, layer in found.layers.items()})


@torch.no_grad()
def test_a_number_of_anchors_is_that_for_any_number_of_photos(tmp_path):
    """A trained model may have another; training draws it."""
    file = tmp_path / "model.safetensors"
    qgs.save(built("model.queries.count=20", "model.queries.least=5"), file)
    model = qgs.load(file)
    assert [model(views(count)).gaussians.count for count in (2, 5)] == [80, 80]
    assert qgs.load(file, gaussians=41)(views()).gaussians.count == 40
    for wrong in (10, 121):
        must_refuse("with 20 to 80 Gaussians", qgs.load, file, gaussians=wrong)
    torch.manual_seed(0)
    drawn = {model.train()(views()).gaussians.count for _ in range(20)}
    assert min(drawn) < 30
    assert 60 < max(drawn) <= 80


def started(learned, file, *overrides):
    """A model that starts from another, which is saved in `file`, and what is said."""
    save(learned, file)
    recipe = resolve(RECIPE, (f"init_from={file}", *overrides))
    model = recipe.build_model().eval()
    return model, initialise(model, recipe)


@pytest.mark.parametrize("kind", [(), (GRADIENT, "model.feedback.rate=0")])
@torch.no_grad()
def test_a_model_without_rounds_starts_one_with_rounds(tmp_path, kind):
    """They repeat its layers: what they add to keys, values and features is 0 at first."""
    plain = built(NO_ROUNDS)
    model, said = started(plain, tmp_path / "plain.safetensors", *kind)
    given = views()
    assert "feedback.marker: none -> (32,)" in said
    name = f"landmark/{model.feedback.name}"
    assert f"trained with model.feedback.type: qgs/none (here {name})" in said
    kept = plain.state_dict()
    assert_equal({name: model.state_dict()[name] for name in kept}, kept)
    memory = model.encoder(given)
    state, _ = run(model, (0, 1, 2, 1, 2, 1, 2), model.queries(memory, given), memory)
    assert_close(model(given).state.features, state.features)


def test_rounds_start_from_rounds_of_their_kind(tmp_path):
    given = built(), tmp_path / "rounds.safetensors"
    more, _ = started(*given, "model.feedback.rounds=3")
    assert_equal(more.state_dict(), given[0].state_dict())
    other = "model.feedback.cells=1"
    must_refuse(r"feedback\.embedding\.weight", started, *given, other, kind=CheckpointError)
    for other in (NO_ROUNDS, "model.feedback={type: landmark/gradient}"):
        model, said = started(*given, other)
        assert "feedback.kv_proj.bias: (64,) -> none" in said
    assert model.feedback.rate.min() > 0


@pytest.mark.parametrize("name", ["tokengs", "locus", "landmark"])
def test_gradients_lower_the_error_of_the_photos(name):
    """In every model, even before it is trained."""
    given = views(side=16)
    swap = ("plugins=[locus, landmark, rooms]", GRADIENT)
    model = resolve(f"tiny/{name}.yaml", swap).build_model().eval()
    errors = []
    for rate in (0.0, 0.05):
        model.feedback.rate.data.fill_(rate)
        with torch.inference_mode():
            rendering = model.render(model(given).gaussians, given.cameras)
        errors.append((rendering.rgb - given.images).square().sum())
    assert errors[1] < errors[0]
