"""Renderers with a wrong background, alpha, depth or gradient."""

from dataclasses import replace

import torch
from contract_mutants.mutant import mutant

from qgs.geometry.harmonics import rotated, seen_colors
from qgs.renderers import TorchRenderer
from qgs.types import Cameras, Gaussians, Rendering

CAMERAS = "camera_gradients_match_differences"
FEATURES = "features_are_blended_as_colours"
HARMONICS = "colours_depend_on_the_direction"
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
    also=f"rendering_is_over_the_background {FEATURES}",
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


@mutant(HARMONICS, "with 3 coefficients, view 0 is off", also="gradients_reach_inputs")
class IgnoresHarmonics(ChangedRenderer):
    def given(self, gaussians, cameras):
        return replace(gaussians, sh=None), cameras


@mutant(HARMONICS, "with 15 coefficients, view 0 is off")
class IgnoresTheThirdDegree(ChangedRenderer):
    def given(self, gaussians, cameras):
        sh = gaussians.sh
        return replace(gaussians, sh=sh if sh is None else sh[..., :8, :]), cameras


@mutant(HARMONICS, "view 1 is off", also="view_permutation")
class LooksFromTheFirstView(ChangedRenderer):
    """In every view it paints what the first one sees."""

    def given(self, gaussians, cameras):
        if gaussians.sh is None:
            return gaussians, cameras
        colors = seen_colors(gaussians, cameras[:, :1])[:, 0]
        return replace(gaussians, sh=None, colors=colors), cameras


@mutant(HARMONICS, "view 0 is off", also="world_frame_makes_no_difference")
class TurnsHarmonicsWithTheWorld(ChangedRenderer):
    """Takes the coefficients for those of another frame: y up."""

    def given(self, gaussians, cameras):
        if gaussians.sh is None:
            return gaussians, cameras
        up = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
        return replace(gaussians, sh=rotated(gaussians.sh, up)), cameras


@mutant(HARMONICS, "with 3 coefficients, view 0 is off", also=FEATURES)
class LetsColoursBeNegative(ChangedRenderer):
    def given(self, gaussians, cameras):
        if gaussians.sh is None:
            return gaussians, cameras
        return replace(gaussians, colors=gaussians.colors + 1), cameras

    def result(self, out):
        return replace(out, rgb=out.rgb - out.alpha)


@mutant(HARMONICS, "coefficients of zero change the image")
class DarkensWithHarmonics(ChangedRenderer):
    """Halves colours that do not depend on the direction where there are coefficients."""

    def given(self, gaussians, cameras):
        if gaussians.sh is None or gaussians.sh.any():
            return gaussians, cameras
        return replace(gaussians, colors=gaussians.colors / 2), cameras


@mutant(FEATURES, "Gaussians with features have none", also=None)
class DropsFeatures(ChangedRenderer):
    def result(self, out):
        return replace(out, features=None)


@mutant(FEATURES, "without features have some", also="")
class InventsFeatures(ChangedRenderer):
    def result(self, out):
        return replace(out, features=out.alpha) if out.features is None else out


@mutant(FEATURES, "features are off by up to")
class PutsFeaturesBeforeTheBackground(ChangedRenderer):
    def result(self, out):
        missing = None if out.features is None else out.features + 0.5 * (1 - out.alpha)
        return replace(out, features=missing)


@mutant(FEATURES, "features are off by up to")
class RendersThreeFeatures(ChangedRenderer):
    """The others are copies of the third."""

    def given(self, gaussians, cameras):
        if gaussians.features is None:
            return gaussians, cameras
        order = [min(i, 2) for i in range(gaussians.features.shape[-1])]
        return replace(gaussians, features=gaussians.features[..., order]), cameras


@mutant(FEATURES, "features change the colours", also=HARMONICS)
class PaintsWithFeatures(ChangedRenderer):
    def given(self, gaussians, cameras):
        if gaussians.features is None:
            return gaussians, cameras
        colors = gaussians.colors + gaussians.features[..., :3]
        return replace(gaussians, colors=colors), cameras


@mutant(GAUSSIANS, "gaussians.sh")
class DoublesAGradientOfHarmonics(ChangedRenderer):
    def given(self, gaussians, cameras):
        sh = gaussians.sh
        return replace(gaussians, sh=sh if sh is None else 2 * sh - sh.detach()), cameras


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
