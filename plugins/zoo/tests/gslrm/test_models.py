"""Models with GS-LRM's parts: they run, or are refused when composed, with the reason."""

import pytest
from odd_views import odd_views
from qgs_dev import Case
from qgs_dev.checks.fields import run_training_step
from qgs_zoo.gslrm.encoder import Transformer
from refusals import refused

from qgs.recipe import resolve

TINY = "tiny/gslrm.yaml"
SMALL = (
    *("model.width=32", "model.heads=2", "model.encoder.depth=1"),
    *(
        "model.centers={type: gslrm/along_rays, near: 0.5, far: 4}",
        "model.renderer={type: qgs/torch}",
    ),
    "plugins=[gslrm, locus, tokengs2026, rooms]",
)
LAYERS = ("model.decoder.depth=1", "model.supervision.layers=[1]", "model.decoder.layer_scale=0.1")
CONTENT = "model.decoder.cross_attention={type: qgs/content}"
ANCHORS = "model.queries={type: locus/anchored, count: 6}"


def test_combinations_run():
    """GS-LRM, with a Gaussian for each pixel, behind TokenGS's networks, its head in LocusGS."""
    multiscale = "type: tokengs2026/multiscale_vit, patch_size: 8, depth: 1, blocks: [1]"
    for overrides in (
        (),
        ("model.head.gaussians_per_query=64",),
        (*LAYERS, CONTENT, "model.encoder={type: qgs/multiview_vit, patch_size: 8, depth: 1}"),
        (
            *(*LAYERS, ANCHORS, f"model.encoder={{{multiscale}}}"),
            "model.decoder.cross_attention={type: locus/ray_biased}",
            "model.centers={type: locus/radius_scaled}",
        ),
    ):
        run_training_step(resolve(TINY, [*SMALL, *overrides]), Case(Transformer.Config()))


def model(*overrides):
    return resolve(TINY, [*SMALL, *overrides]).build_model()


def test_what_cannot_work_is_refused():
    for overrides, option in (
        ((*LAYERS, CONTENT), "model.decoder.cross_attention"),  # no keys
        ((ANCHORS,), "model.queries"),  # no patches
        (("model.centers.near=4",), "model.centers.near"),
        (("data.image_size=[60, 64]",), "data.image_size"),
    ):
        assert refused(TINY, [*SMALL, *overrides]).option == option
    with pytest.raises(ValueError, match="images of 60 x 64 cannot be cut into patches of 8"):
        model()(odd_views(1, 60, 64))
