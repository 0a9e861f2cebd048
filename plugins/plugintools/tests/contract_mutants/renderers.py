"""Renderers with a wrong background, alpha, depth or gradient."""

from dataclasses import replace

import torch
from contract_mutants.mutant import mutant

from qgs.renderers import TorchRenderer
from qgs.types import Cameras, Gaussians, Rendering

CAMERAS = "camera_gradients_match_differences"
GAUSSIANS = "render_gradients_match_differences"


class ChangedRenderer(TorchRenderer):
    """A sound renderer, whose inputs or output mutants change."""

    def given(self, gaussians: Gaussians, cameras: Cameras) -> tuple[Gaussians, Cameras]:
        return gaussians, cameras

    def result(self, out: Rendering) -> Rendering:
        return out

    def forward(self, gaussians, cameras, background=None):
        return self.result(super().forward(*self.given(gaussians, cameras), background))


@mutant(
    "no_gaussians_give_the_background",
    "not the background",
    also="rendering_is_over_the_background",
)
class HasItsOwnBackground(TorchRenderer):
    def forward(self, gaussians, cameras, background=None):
        return super().forward(gaussians, cameras)


@mutant("no_gaussians_give_the_background", "of c2w")
class TakesARootOfTheNumberOfGaussians(TorchRenderer):
    """Its gradient is infinite at none."""

    def forward(self, gaussians, cameras, background=None):
        out = super().forward(gaussians, cameras, background)
        reach = 1 + cameras.c2w[..., :3, 3].square().sum()
        return replace(out, rgb=out.rgb + 0 * (gaussians.means.shape[1] * reach).sqrt())


@mutant("rendering_is_over_the_background", "the background shows", also="depth_is_expected")
class SquaresAlpha(ChangedRenderer):
    def result(self, out):
        return replace(out, alpha=out.alpha.square())


@mutant("depth_is_expected", "depth is off by")
class WeighsDepthByAlpha(ChangedRenderer):
    """Gives sum(w z), as if every pixel were opaque."""

    def result(self, out):
        return replace(out, depth=out.alpha * out.depth)


@mutant(GAUSSIANS, "`gaussians.means`")
@mutant(CAMERAS, "`cameras.c2w`")
class DetachesDepth(ChangedRenderer):
    def result(self, out):
        return replace(out, depth=out.depth.detach())


@mutant(GAUSSIANS, "`gaussians.means`")
@mutant(CAMERAS, "`cameras.c2w`")
class DetachesAlpha(ChangedRenderer):
    def result(self, out):
        return replace(out, alpha=out.alpha.detach())


@mutant(GAUSSIANS, "gaussians.colors")
class DoublesAGradient(ChangedRenderer):
    def given(self, gaussians, cameras):
        colors = 2 * gaussians.colors - gaussians.colors.detach()
        return replace(gaussians, colors=colors), cameras


@mutant(GAUSSIANS, "`gaussians.means`")
class HasNoGradientInZ(ChangedRenderer):
    def given(self, gaussians, cameras):
        x, y, z = gaussians.means.unbind(-1)
        return replace(gaussians, means=torch.stack([x, y, z.detach()], -1)), cameras


@mutant(CAMERAS, "`cameras.c2w`")
class HasNoGradientInPositions(ChangedRenderer):
    def given(self, gaussians, cameras):
        turned, position = cameras.c2w[..., :3], cameras.c2w[..., 3:].detach()
        return gaussians, replace(cameras, c2w=torch.cat([turned, position], -1))


@mutant(CAMERAS, "and gets none")
class DetachesIntrinsicsSilently(ChangedRenderer):
    camera_gradients = ("c2w",)

    def given(self, gaussians, cameras):
        return gaussians, replace(cameras, intrinsics=cameras.intrinsics.detach())


@mutant(
    CAMERAS,
    "is refused",
    also="no_gaussians_give_the_background gradients_reach_inputs batch_independence "
    "zeros_stay_finite large_numbers_stay_finite coincident_queries_stay_finite "
    "points_behind_cameras_stay_finite duplicated_view_stays_finite inputs_are_not_changed",
)
class RefusesWhatItDeclares(ChangedRenderer):
    def given(self, gaussians, cameras):
        if cameras.intrinsics.requires_grad:
            raise ValueError("there is no gradient of intrinsics; detach them")
        return gaussians, cameras


@mutant(CAMERAS, "names size")
class DeclaresAGradientInSize(TorchRenderer):
    camera_gradients = ("c2w", "size")
