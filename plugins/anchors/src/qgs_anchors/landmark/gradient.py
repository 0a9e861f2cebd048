"""`landmark/gradient`: feedback of the gradient of rendering errors to the queries, in rounds."""

import torch
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from qgs.containers import map_tensors
from qgs.contracts import Decode, ModelDims, Render
from qgs.precision import full_precision
from qgs.types import ImageMemory, QueryState, Views
from qgs_anchors.landmark.rounds import RoundsFeedback

MOMENTUM = 0.5
"""Part of a step that the next step repeats."""
TINY = 1e-12
"""Least divisor of gradients, for scenes that are rendered without an error."""


class GradientFeedback(RoundsFeedback):
    """Feedback that moves the features of queries against the gradient of the rendering error.

    The error is the sum of squared differences between the input photos and their renderings. Its
    gradient g with respect to the features comes through head and centers, so any number of
    Gaussians fits. A step adds v to the features. It is v = MOMENTUM v' - rate * h, with v' the
    step before and h = sign(g) log(1 + |g| / s). The rate is learned for each channel; s is the
    root mean square of g in a scene. Then the last layers run again.

    Training treats the gradient as an input, and does not differentiate it again.
    """

    name = "gradient"
    learned = "rate"

    class Config(RoundsFeedback.Config):
        layers: PositiveInt = 1
        """Number of decoder layers, counted from the last, that each feedback round runs again
        after its steps."""
        steps: PositiveInt = 2
        """Number of steps against the gradient in a round. Each renders all input photos, at
        once."""
        rate: NonNegativeFloat = 0.05
        """Initial rate of steps, also in a model that starts from one without such rounds."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.rate = nn.Parameter(torch.full((dims.width,), config.rate))

    def forward(
        self,
        state: QueryState,
        memory: ImageMemory,
        views: Views,
        decode: Decode,
        render: Render,
    ) -> tuple[QueryState, ImageMemory]:
        step_BND = torch.zeros_like(state.features)
        for _ in range(self.config.steps):
            slope_BND = normalised_slope(state, views, decode, render)
            step_BND = MOMENTUM * step_BND - self.rate * slope_BND
            state = state.replace(features=state.features + step_BND)
        return state.replace(features=state.features + self.marker), memory


@full_precision
def normalised_slope(
    state: QueryState,
    views: Views,
    decode: Decode,
    render: Render,
) -> Tensor:
    """Return h = sign(g) log(1 + |g| / s), of shape (B, N, D), as `GradientFeedback` explains."""
    # Tensors of inference mode have no gradients, but copies outside it do.
    with torch.inference_mode(False), torch.enable_grad():
        state, cameras = map_tensors(lambda x: x.detach().clone(), (state, views.cameras))
        features = state.features.requires_grad_()
        rendering = render(decode(state), cameras)
        error = (rendering.rgb - views.images).square().sum()
        (g_BND,) = torch.autograd.grad(error, features)
    square_BN = g_BND.square().mean(-1)
    # Padding has no gradient, and must not count.
    count = square_BN.shape[1] if state.mask is None else state.mask.sum(1, keepdim=True)
    s_B1 = (square_BN.sum(1, keepdim=True) / count).sqrt()
    return g_BND.sign() * torch.log1p(g_BND.abs() / (s_B1[..., None] + TINY))
