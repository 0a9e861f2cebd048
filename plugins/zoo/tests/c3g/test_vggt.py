"""VGGT's features, with a stand-in for VGGT that has its interface and a few weights."""

import sys
from types import SimpleNamespace

import pytest
import qgs_zoo.c3g.vggt
import torch
from odd_views import odd_views
from qgs_dev import Case, CaseRun
from qgs_zoo.c3g.vggt import MODULE, VggtFeatures
from safetensors.torch import load_file, save_file
from small_parts import made
from tables import assert_equal, must_refuse
from torch import nn

import qgs
from qgs.contracts import MissingExtraError, ModelDims
from qgs.recipe import resolve

C = 8
"""Width of the stand-in's tokens in place of 2048."""
GIVEN = odd_views(3, 28, 42)


class Aggregator(nn.Module):
    """As VGGT's: all layers' tokens (B, V, 5 + P, C), the first five of no patch."""

    def __init__(self):
        super().__init__()
        self.decay = [x.item() for x in torch.linspace(0, 1, 3)]  # VGGT's constructor does
        self.patch = nn.Conv2d(3, C, 14, 14)

    def forward(self, images):
        tokens = self.patch(images.flatten(0, 1)).flatten(2).mT.unflatten(0, images.shape[:2])
        tokens = torch.tanh(tokens) + tokens[:, :1].mean(2, keepdim=True)
        return [torch.zeros(()), nn.functional.pad(tokens, (0, 0, 5, 0), value=7.0)], 5


@pytest.fixture(autouse=True)
def vggt(monkeypatch):
    monkeypatch.setitem(sys.modules, MODULE, SimpleNamespace(Aggregator=Aggregator))
    monkeypatch.setattr(qgs_zoo.c3g.vggt, "WIDTH", C)


@pytest.fixture
def weights(tmp_path):
    """A file of all of VGGT's weights, which has more than the aggregator's."""
    own = {f"aggregator.{name}": x for name, x in Aggregator().state_dict().items()}
    save_file({**own, "camera_head.weight": torch.zeros(2)}, tmp_path / "model.safetensors")
    return tmp_path / "model.safetensors"


def encoder(weights, width=C, **options):
    component = made(VggtFeatures, ModelDims(width, 2, 1), weights=str(weights), **options)
    component.load_pretrained()
    return component


def test_it_gives_the_patch_tokens_of_the_last_layer(weights):
    """Of images in [-1, 1] or, as told, in [0, 1]."""
    for told, images in (({}, GIVEN.images * 2 - 1), ({"images": "unit"}, GIVEN.images)):
        component = encoder(weights, **told)
        memory = component(GIVEN)
        assert_equal(memory.features, component.aggregator(images)[0][-1][:, :, 5:].flatten(1, 2))
        assert memory.grid == (3, 2, 3)
        assert memory.keys is memory.values is memory.patch_rays is None


def test_a_model_of_another_width_has_a_linear_layer(weights):
    narrow = encoder(weights, width=6)
    assert narrow(GIVEN).features.shape[-1] == 6
    assert narrow.proj.weight.shape == (6, C)
    assert not [*encoder(weights).proj.parameters()]


def test_weights_are_the_users(weights):
    given = load_file(weights)
    del given["camera_head.weight"]
    assert_equal(encoder(weights).aggregator.state_dict(prefix="aggregator."), given)


def small(weights):
    """The tiny recipe with VGGT's encoder, as C3G has it."""
    overrides = [
        f"model.encoder={{type: c3g/vggt_features, weights: {weights}}}",
        "model={width: 8, heads: 2, queries: {count: 6}}",
        "data.image_size=[28, 42]",
        "optimizer.parts={encoder: 0.01, queries: 0.01}",
    ]
    return resolve("tiny/c3g.yaml", overrides)


def test_without_vggt_the_message_names_what_installs_it(weights, monkeypatch):
    monkeypatch.setitem(sys.modules, MODULE, None)
    recipe = small(weights)
    for device in ("cpu", "meta"):
        must_refuse(
            r"pip install git\+https.*qgs/multiview_vit",
            recipe.build_model,
            device,
            kind=MissingExtraError,
        )


def test_a_checkpoint_needs_no_file_of_weights(weights, tmp_path):
    recipe = small(weights)
    model = recipe.build_model().eval()
    qgs.save(model, tmp_path / "checkpoint.safetensors")
    weights.unlink()
    loaded = qgs.load(tmp_path / "checkpoint.safetensors")
    assert_equal(loaded(GIVEN).gaussians.means, model(GIVEN).gaussians.means)
    must_refuse("cannot read weights", recipe.build_model, kind=MissingExtraError)


def test_it_keeps_the_contract_of_encoders(weights):
    CaseRun(Case(VggtFeatures.Config(weights=str(weights)))).check(["core"])
