import pytest

from qgs.analysis.report import Baseline, Contender, Report, report_html
from qgs.cli.contest import true_depth
from qgs.composer import resolve
from qgs.data.evaluation import evaluation_samples
from qgs.drawing.figures import Curves

PLAIN = {
    "recipe": 1,
    "model": {
        "width": 16,
        "heads": 2,
        "encoder": {"type": "qgs/multiview_vit", "patch_size": 8, "depth": 1},
        "queries": {"type": "qgs/latent", "count": 16, "std": 1.0},
        "decoder": {"depth": 2},
        "head": {"type": "qgs/gaussian_head", "gaussians_per_query": 4},
        "supervision": {"type": "qgs/layers", "layers": [2]},
    },
    "plugins": ["rooms"],
    "data": {"type": "rooms/procedural", "image_size": [16, 16], "test_scenes": 2},
    "views": {"inputs": 2, "targets": 2, "gap": [3, 4], "scale_factor": 0.4},
    "evaluation": {"scenes": 2},
}


def anchored() -> dict:
    pytest.importorskip("qgs_locus")
    model = {
        **PLAIN["model"],
        "queries": {"type": "locus/anchored", "count": 16, "std": 1.0, "init_radius": 0.3},
        "decoder": {
            "depth": 2,
            "cross_attention": {"type": "locus/ray_biased"},
            "refinement": {"type": "locus/refine"},
        },
        "centers": {"type": "locus/radius_scaled"},
    }
    return {**PLAIN, "plugins": ["locus", "rooms"], "model": model}


def page_of(tree: dict, name: str) -> str:
    recipe = resolve(tree)
    source = recipe.build_data()
    samples = evaluation_samples(source, recipe.views, recipe.evaluation)
    contender = Contender(
        name=name,
        model=recipe.build_model().eval(),
        psnr=12.34,
        ssim=0.5,
        dispersion_mean=0.7,
        dispersion_median=0.6,
        gaussians=64,
        parameters=1000,
        seconds=1.0,
        curves=Curves([0.0, 1.0], [1.0, 0.5], [8.0, 9.0]),
        recipe="recipe: 1",
    )
    report = Report(
        title="A title",
        contenders=[contender],
        baselines=[Baseline("Mean colour", 11.11, 0.4)],
        samples=samples,
        depths=[true_depth(source, sample) for sample in samples],
        facts={"Budget": "none"},
    )
    return report_html(report)


def test_anchors_are_shown_layer_by_layer_and_attention_with_its_geometry():
    page = page_of(anchored(), "with anchors")
    assert "learned start" in page
    assert "after layer 2" in page
    assert "geometry bias" in page


def test_queries_without_a_place_have_no_anchor_section():
    page = page_of(PLAIN, "plain")
    assert "Where queries look" not in page
    assert "geometry bias</figcaption>" not in page
    assert "content logits" in page
    assert "Truth, depth" in page
    assert page.count('src="data:image/webp;base64,') == 1
    assert page.count("<h2>") == 7
    assert "12.34" in page
    assert "11.11" in page


def test_names_cannot_break_the_page():
    page = page_of(PLAIN, "<script>alert(1)</script>")
    assert "<script>" not in page


def test_true_depth_is_in_the_units_of_the_sample():
    recipe = resolve(PLAIN)
    source = recipe.build_data()
    sample = evaluation_samples(source, recipe.views, recipe.evaluation)[0]
    own = source.scenes("test")[0].depths(sample.target_frames)
    ratio = true_depth(source, sample) / own
    assert ratio.min() == pytest.approx(recipe.views.scale_factor, rel=1e-3)
    assert ratio.max() == pytest.approx(recipe.views.scale_factor, rel=1e-3)
