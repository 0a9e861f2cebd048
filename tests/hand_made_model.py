"""A TokenGS of a few thousand parameters, a hand-made scene, cameras that look at it."""

import pytest
import torch

from qgs.components import (
    ContentCrossAttention,
    ContentSelfAttention,
    CrossSelfMlp,
    FreeCenters,
    GaussianHead,
    LatentQueries,
    LayerSupervision,
    MlpFeedForward,
    MultiViewViT,
    NoFeedback,
    NoRefinement,
)
from qgs.contracts import LayerParts, ModelDims
from qgs.model import QueryGaussianModel
from qgs.renderers.reference import TorchRenderer
from qgs.types import Cameras, Gaussians, Views

QUERIES, PER_QUERY, DEPTH = 12, 4, 3


def build_model():
    torch.manual_seed(0)
    dims = ModelDims(width=16, heads=2, depth=DEPTH)

    def make(component, **options):
        return component(component.Config(**options), dims)

    def layer():
        kinds = (ContentCrossAttention, ContentSelfAttention, MlpFeedForward)
        sublayers = {kind.slot: make(kind) for kind in kinds}
        return CrossSelfMlp(CrossSelfMlp.Config(), LayerParts(dims, sublayers, 0.1))

    return QueryGaussianModel(
        decoder=[layer() for _ in range(DEPTH)],
        refinements=[make(NoRefinement)] * DEPTH,
        head=make(GaussianHead, gaussians_per_query=PER_QUERY, init_std=0.3, scale_cap=0.2),
        encoder=make(MultiViewViT, patch_size=8, depth=1),
        queries=make(LatentQueries, count=QUERIES, std=1.0),
        feedback=make(NoFeedback),
        centers=make(FreeCenters),
        supervision=LayerSupervision(LayerSupervision.Config(layers=(DEPTH,))),
        renderer=TorchRenderer(TorchRenderer.Config()),
    ).eval()


@pytest.fixture
def model():
    return build_model()


@pytest.fixture
def cameras():
    """Two cameras (1, 2) of 32x32, the identity and one to its right."""
    c2w = torch.eye(4).repeat(1, 2, 1, 1)
    c2w[0, 1, 0, 3] = 0.3
    intrinsics = torch.tensor([32.0, 32.0, 16.0, 16.0]).expand(1, 2, 4)
    return Cameras(c2w, intrinsics, (32, 32))


@pytest.fixture
def views(cameras):
    generator = torch.Generator().manual_seed(1)
    return Views(torch.rand(1, 2, 3, 32, 32, generator=generator), cameras)


@pytest.fixture
def gaussians():
    """As many as the model makes, spread over what the cameras see."""
    generator = torch.Generator().manual_seed(2)
    count = QUERIES * PER_QUERY
    xy = torch.rand(1, count, 2, generator=generator) - 0.5
    z = torch.rand(1, count, 1, generator=generator) + 1
    return Gaussians(
        means=torch.cat([xy * z, z], -1),
        scales=torch.full((1, count, 3), 0.05),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(1, count, 4),
        opacities=torch.full((1, count), 0.8),
        colors=torch.rand(1, count, 3, generator=generator),
    )
