import re

import pytest
from commands import MODEL

from qgs.analysis.report import Contender, Report, report_html
from qgs.composer import resolve
from qgs.contracts import Column
from qgs.data.evaluation import evaluation_samples, true_depth
from qgs.drawing.figures import Curves

PLAIN = {
    "recipe": 1,
    "model": {
        **MODEL,
        "decoder": {"depth": 2},
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
        "queries": {"type": "locus/anchored", "count": 8, "std": 1.0, "init_radius": 0.3},
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
        scores={"psnr": 12.34, "mine": 0.5, "none": None},
        gaussians=64,
        parameters=1000,
        recipe="recipe: 1",
        about="Small, see https://example.org/small for more.",
        curves=Curves([0.0, 1.0], [1.0, 0.5], [8.0, 9.0]),
    )
    report = Report(
        columns={
            "psnr": Column("PSNR", "higher", 2, "dB"),
            "mine": Column("my metric", "lower"),
            "none": Column("no value", "lower"),
        },
        title="A title",
        contenders=[contender],
        baselines={"Mean colour": {"psnr": 11.11, "mine": None, "none": None}},
        samples=samples,
        depths=[true_depth(source, sample) for sample in samples],
        facts={"Budget": "none"},
        notes=["The photos lie outside."],
        meanings=["What my metric means."],
        commands={"qgs list": "lists"},
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
    assert '<td class="best">12.34</td>' in page
    assert '<td class="best">0.500</td>' in page
    assert "<th>my metric ↓<small>" in page
    assert "<td>11.11</td>" in page
    assert 'Small, see <a href="https://example.org/small"' in page
    assert page.index("The photos lie outside.") < page.index("<table>")
    assert "<br>What my metric means." in page
    assert "Next: <code>qgs list</code> lists." in page
    assert "token" not in re.sub(r"data:[^\"]+|[a-z]*TokenGS", "", page)


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
