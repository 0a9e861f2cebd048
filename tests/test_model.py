"""The model as a whole, composed from the tiny recipes made smaller still, and printed."""

import re

import pytest
import torch
from commands import SMALL
from odd_views import odd_views
from tables import must_refuse
from torch import nn

import qgs


def small(name, *overrides):
    return qgs.compose(f"tiny/{name}.yaml", [*SMALL, *overrides]).eval()


VIEWS = odd_views(width=24)


@pytest.mark.parametrize("name", ["tokengs", "locus"])
def test_the_api_in_five_lines(name, tmp_path):
    model = small(name)
    gaussians = model(VIEWS).gaussians
    assert gaussians.means.shape == (2, 8 * 8, 3)
    black, white = (
        model.render(gaussians, VIEWS.cameras, torch.full((3,), grey)) for grey in (0.0, 1.0)
    )
    assert black.rgb.shape == VIEWS.images.shape
    torch.testing.assert_close(white.rgb - black.rgb, (1 - black.alpha).expand_as(black.rgb))
    qgs.save(model, tmp_path / "model.safetensors")
    again = qgs.load(tmp_path / "model.safetensors")
    assert torch.equal(again(VIEWS.to(torch.float64)).gaussians.means, gaussians.means)


def test_layers_that_are_decoded_and_refined():
    model = small("locus")
    assert list(model.train()(VIEWS).layers) == [2, 4]
    assert list(model.eval()(VIEWS).layers) == [4]
    assert list(model(VIEWS, layers=[1, 3]).layers) == [1, 3, 4]
    must_refuse(r"layers \[5\] do not exist", model, VIEWS, layers=[5])
    override = "model.decoder.layers.0.refinement={type: locus/refine, radius: false}"
    assert [len(x.refinements) for x in (model, small("locus", override))] == [1, 2]


def test_a_model_says_its_slots_in_a_few_lines():
    model = small("locus", "model.decoder.layers.0.cross_attention.type=qgs/content")
    heading, *lines = repr(model).splitlines()
    total = sum(parameter.numel() for parameter in model.parameters())
    assert f"{total:,} parameters" in heading
    assert "8 queries of 8 Gaussians" in heading
    cells = r"^  decoder\.cross_attention +qgs/content, locus/ray_biased +[\d,]+$"
    assert re.search(cells, repr(model), re.M)
    assert sum(int(line.split()[-1].replace(",", "")) for line in lines[:10]) == total
    assert "queries of" not in repr(qgs.compose("tiny/landmark.yaml", device="meta"))


def test_compile_captures_graphs_on_cuda(monkeypatch):
    given = []
    monkeypatch.setattr(nn.Module, "compile", lambda model, **options: given.append(options))
    small("tokengs").compile()
    monkeypatch.setattr(qgs.QueryGaussianModel, "device", torch.device("cuda"))
    small("tokengs").compile()
    assert given == [{}, {"mode": "reduce-overhead"}]
