"""Renderers with a wrong background, alpha, depth or gradient."""

from dataclasses import replace
from typing import Any

from contract_mutants.mutant import mutant

from qgs.renderers import TorchRenderer
from qgs.types import Cameras, Gaussians

CAMERAS = "camera_gradients_match_differences"
FEATURES = "features_are_blended_as_colours"
HARMONICS = "colours_depend_on_the_direction"
GAUSSIANS = "render_gradients_match_differences"


class ChangedResult:
    """A sound component, whose output mutants change."""

    def result(self, out: Any) -> Any:
        return out

    def forward(self, *given):
        return self.result(super().forward(*given))


class ChangedRenderer(ChangedResult, TorchRenderer):
    """A sound renderer, whose inputs or output mutants change."""

    def given(self, gaussians: Gaussians, cameras: Cameras) -> tuple[Gaussians, Cameras]:
        return gaussians, cameras

    def forward(self, gaussians, cameras, background=None):
        return super().forward(*self.given(gaussians, cameras), background)


@mutant("no_gaussians_give_the_background", "not the background")
class HasItsOwnBackground(TorchRenderer):
    def forward(self, gaussians, cameras, background=None):
        return super().forward(gaussians, cameras)


@mutant("rendering_is_over_the_background", "the weight of the background is not")
class SquaresAlpha(ChangedRenderer):
    def result(self, out):
        return replace(out, alpha=out.alpha.square())


@mutant("depth_is_expected", "depth is not the expected z")
class WeighsDepthByAlpha(ChangedRenderer):
    """Gives sum(w z), as if every pixel were opaque."""

    def result(self, out):
        return replace(out, depth=out.alpha * out.depth)


@mutant(HARMONICS, "with 15 coefficients, view 0 has other colours")
class IgnoresTheThirdDegree(ChangedRenderer):
    def given(self, gaussians, cameras):
        sh = gaussians.sh
        return replace(gaussians, sh=sh if sh is None else sh[..., :8, :]), cameras


@mutant(HARMONICS, "coefficients of zero change the image")
class DarkensWithHarmonics(ChangedRenderer):
    """Halves colours that do not depend on the direction where there are coefficients."""

    def given(self, gaussians, cameras):
        if gaussians.sh is None or gaussians.sh.any():
            return gaussians, cameras
        return replace(gaussians, colors=gaussians.colors / 2), cameras


@mutant(FEATURES, "the rendering has no features")
class DropsFeatures(ChangedRenderer):
    def result(self, out):
        return replace(out, features=None)


@mutant(FEATURES, "features change the colours")
class PaintsWithFeatures(ChangedRenderer):
    def given(self, gaussians, cameras):
        if gaussians.features is None:
            return gaussians, cameras
        return replace(gaussians, colors=gaussians.colors + gaussians.features[..., :3]), cameras


@mutant(GAUSSIANS, "`gaussians.means`")
@mutant(CAMERAS, "`cameras.c2w`")
class DetachesDepth(ChangedRenderer):
    def result(self, out):
        return replace(out, depth=out.depth.detach())


@mutant(GAUSSIANS, "gaussians.colors")
class DoublesAGradient(ChangedRenderer):
    def given(self, gaussians, cameras):
        colors = 2 * gaussians.colors - gaussians.colors.detach()
        return replace(gaussians, colors=colors), cameras


@mutant(CAMERAS, "and gets none")
class DetachesIntrinsicsSilently(ChangedRenderer):
    camera_gradients = ("c2w",)

    def given(self, gaussians, cameras):
        return gaussians, replace(cameras, intrinsics=cameras.intrinsics.detach())


@mutant(CAMERAS, "gradient is refused")
class RefusesWhatItDeclares(ChangedRenderer):
    def given(self, gaussians, cameras):
        if cameras.intrinsics.requires_grad:
            raise ValueError("there is no gradient of intrinsics; detach them")
        return gaussians, cameras
