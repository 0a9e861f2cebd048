"""What models and containers look like when printed."""

import re

import pytest
import torch

import qgs
from qgs.types import Cameras, GaussianAttributes, Views

SMALL = {
    "recipe": 1,
    "plugins": ["locus"],
    "model": {
        "width": 32,
        "heads": 2,
        "queries": {"type": "locus/anchored", "count": 8},
        "decoder": {
            "depth": 2,
            "layers": {"1": {"cross_attention": {"type": "locus/ray_biased"}}},
        },
        "head": {"gaussians_per_query": 4},
        "supervision": {"layers": [2]},
    },
}


@pytest.fixture(scope="module")
def model():
    return qgs.compose(SMALL).eval()


def views(distance: float = 0.2) -> Views:
    c2w = torch.eye(4).repeat(1, 2, 1, 1)
    c2w[:, 1, 0, 3] = distance
    intrinsics = torch.tensor([20.0, 20.0, 16.0, 16.0]).expand(1, 2, 4)
    generator = torch.Generator().manual_seed(0)
    return Views(
        torch.rand(1, 2, 3, 32, 32, generator=generator), Cameras(c2w, intrinsics, (32, 32))
    )


def test_a_model_says_its_slots_in_a_few_lines(model):
    heading, *lines = repr(model).splitlines()
    total = sum(parameter.numel() for parameter in model.parameters())
    assert f"{total:,} parameters" in heading
    assert "8 queries of 4 Gaussians" in heading
    assert len(lines) == 11
    assert re.search(
        r"^  decoder\.cross_attention +qgs/content, locus/ray_biased +[\d,]+$", repr(model), re.M
    )
    counts = [int(line.split()[-1].replace(",", "")) for line in lines[:9]]
    assert sum(counts) == total
    for word in ("locus/anchored", "qgs/gaussian_head", "qgs/auto"):
        assert word in repr(model)


def test_a_model_built_by_hand_is_told_by_its_classes(model):
    model = qgs.compose(SMALL)
    model.recipe = None
    assert re.search(r"^  head +GaussianHead ", repr(model), re.M)


def test_containers_tell_shapes_and_no_numbers(model):
    prediction = model(views(), layers=[1])
    text = repr(prediction)
    assert len(text) < 400
    assert "means: (1, 32, 3)" in text
    assert "fields: {anchor.center: (1, 8, 3), anchor.raw_radius: (1, 8, 1)}" in text
    assert "layers: {1: LayerPrediction, 2: LayerPrediction}" in text
    assert (
        repr(views().cameras) == "Cameras(c2w: (1, 2, 4, 4), intrinsics: (1, 2, 4), size: (32, 32))"
    )
    assert repr(views()).splitlines()[1:] == [
        "  images: (1, 2, 3, 32, 32)",
        f"  cameras: {views().cameras!r}",
        "  masks: None",
        "  times: None",
        "  target_time: None",
        ")",
    ]
    assert "c2w: (1, 2, 4, 4) float64" in repr(views().cameras.to(torch.float64))
    assert "float32" not in text
    assert "c2w: (1, 2, 4, 4) meta" in repr(views().cameras.to("meta"))
    attributes = GaussianAttributes(
        *(torch.zeros(1, 2, 4, n) for n in (3, 3, 4)),
        *[torch.zeros(1, 2, 4)],
        torch.zeros(1, 2, 4, 3),
    )
    assert repr(attributes).startswith("GaussianAttributes(offsets: (1, 2, 4, 3), ")
