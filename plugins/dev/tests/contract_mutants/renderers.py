"""Renderers with a wrong background, alpha, depth or gradient."""

from contract_mutants.mutant import mutant

from qgs.renderers import TorchRenderer

CAMERAS = "camera_gradients_match_differences"
FEATURES = "features_are_blended_as_colours"
HARMONICS = "colours_depend_on_the_direction"
GAUSSIANS = "render_gradients_match_differences"


class ChangedResult:
    """A sound component, whose output mutants change."""

    def result(self, out):
        return out

    def forward(self, *given):
        return self.result(super().forward(*given))


class ChangedRenderer(ChangedResult, TorchRenderer):
    """A sound renderer, whose inputs or output mutants change."""

    def drawn(self, gaussians):
        return gaussians

    def seen_by(self, cameras):
        return cameras

    def forward(self, gaussians, cameras, background=None):
        return super().forward(self.drawn(gaussians), self.seen_by(cameras), background)


@mutant("no_gaussians_give_the_background", "not the background")
class HasItsOwnBackground(TorchRenderer):
    def forward(self, gaussians, cameras, background=None):
        return super().forward(gaussians, cameras)


@mutant("rendering_is_over_the_background", "the weight of the background is not")
class SquaresAlpha(ChangedRenderer):
    def result(self, out):
        return out.replace(alpha=out.alpha.square())


@mutant("depth_is_expected", "depth is not the expected z")
class WeighsDepthByAlpha(ChangedRenderer):
    """Gives sum(w z), as if every pixel were opaque."""

    def result(self, out):
        return out.replace(depth=out.alpha * out.depth)


@mutant(HARMONICS, "with 15 coefficients, view 0 has other colours")
class IgnoresTheThirdDegree(ChangedRenderer):
    def drawn(self, gaussians):
        sh = gaussians.sh
        return gaussians.replace(sh=sh if sh is None else sh[..., :8, :])


@mutant(HARMONICS, "coefficients of zero change the image")
class DarkensWithHarmonics(ChangedRenderer):
    """Halves colours that do not depend on the direction where there are coefficients."""

    def drawn(self, gaussians):
        if gaussians.sh is None or gaussians.sh.any():
            return gaussians
        return gaussians.replace(colors=gaussians.colors / 2)


@mutant(FEATURES, "the rendering has no features")
class DropsFeatures(ChangedRenderer):
    def result(self, out):
        return out.replace(features=None)


@mutant(FEATURES, "features change the colours")
class PaintsWithFeatures(ChangedRenderer):
    def drawn(self, gaussians):
        if gaussians.features is None:
            return gaussians
        return gaussians.replace(colors=gaussians.colors + gaussians.features[..., :3])


@mutant(GAUSSIANS, "`gaussians.means`")
@mutant(CAMERAS, "`cameras.c2w`")
class DetachesDepth(ChangedRenderer):
    def result(self, out):
        return out.replace(depth=out.depth.detach())


@mutant(GAUSSIANS, "gaussians.colors")
class DoublesAGradient(ChangedRenderer):
    def drawn(self, gaussians):
        return gaussians.replace(colors=2 * gaussians.colors - gaussians.colors.detach())


@mutant(CAMERAS, "and gets none")
class DetachesIntrinsicsSilently(ChangedRenderer):
    camera_gradients = ("c2w",)

    def seen_by(self, cameras):
        return cameras.replace(intrinsics=cameras.intrinsics.detach())


@mutant(CAMERAS, "gradient is refused")
class RefusesWhatItDeclares(ChangedRenderer):
    def seen_by(self, cameras):
        if cameras.intrinsics.requires_grad:
            raise ValueError("there is no gradient of intrinsics; detach them")
        return cameras
