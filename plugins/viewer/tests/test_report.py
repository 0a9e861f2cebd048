from html.parser import HTMLParser
from importlib.metadata import entry_points

import numpy as np
import pytest
from commands import MODEL
from qgs_viewer.curves import Curves
from qgs_viewer.report import GROUP, Contender, Report, report_html

from qgs.composer import resolve
from qgs.contracts import Column
from qgs.data.evaluation import evaluation_samples
from qgs.drawing.images import EXACT, data_uri
from qgs.wording import warn_once

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


@pytest.fixture(autouse=True)
def _only_sections_of_the_test(monkeypatch):
    """Whether the viewer is installed makes no difference."""
    monkeypatch.setattr(
        "qgs_viewer.report.entry_points",
        lambda group: [e for e in entry_points(group=group) if e.module.startswith("_test_")],
    )


def page_of(tree: dict, name: str) -> str:
    recipe = resolve(tree)
    source = recipe.build_data()
    samples = evaluation_samples(source, recipe.views, recipe.evaluation, depths=True)
    contender = Contender(
        name=name,
        model=recipe.build_model().eval(),
        scores={"psnr": 12.34, "mine": 0.5, "none": None},
        gaussians=64,
        parameters=1000,
        recipe="recipe: 1",
        about="Small, see https://example.org/small for more.",
        curves=Curves([0.0, 1.0], [1.0, 0.5], [8.0, 9.0], [1, 2]),
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
        facts={"Budget": "none"},
        notes=["The photos lie outside."],
        meanings=["What my metric means."],
        commands={"qgs list": "lists"},
    )
    return report_html(report)


def test_names_cannot_break_the_page():
    page = page_of(PLAIN, "<script>alert(1)</script>")
    assert "<script>alert" not in page
    assert page.count("<script>") == 1
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page


class Elements(HTMLParser):
    """Start tags of a page, in order, with their attributes."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str]]] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, {name: value or "" for name, value in attrs}))

    def of(self, tag: str) -> list[dict[str, str]]:
        return [attributes for found, attributes in self.found if found == tag]


@pytest.fixture(scope="module")
def plain():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qgs_viewer.report.entry_points", lambda group: [])
        return Elements(page_of(PLAIN, "plain"))


def test_every_scene_can_be_chosen_and_is_there_without_choosing(plain):
    scenes = PLAIN["evaluation"]["scenes"]
    radios = [found for found in plain.of("input") if found["type"] == "radio"]
    assert len(radios) == len(plain.of("article")) == scenes
    assert [found["for"] for found in plain.of("label")] == [found["id"] for found in radios]
    assert [("checked" in found) for found in radios] == [True] + [False] * (scenes - 1)


def test_pictures_are_in_the_page_and_have_words(plain):
    pictures = plain.of("img")
    zoomed = [picture for picture in pictures if "src" not in picture]
    assert len(zoomed) == 1, "only the one that shows others in large is empty"
    for picture in pictures:
        assert picture.get("src", "data:").startswith("data:")
    wordless = [picture for picture in pictures if not picture["alt"] and picture not in zoomed]
    assert len(wordless) == PLAIN["evaluation"]["scenes"], "thumbnails beside their names"
    alts = {picture["alt"] for picture in pictures}
    assert {"plain, error", "plain, depth", "Truth, depth"} <= alts
    sliders = [found for found in plain.of("input") if found["type"] == "range"]
    assert len(sliders) == PLAIN["evaluation"]["scenes"]
    assert all("plain" in found["aria-label"] for found in sliders)
    for _, attributes in plain.found:
        outward = {*attributes} & {"src", "srcset", "data", "poster", "action"}
        assert all(attributes[name].startswith("data:") for name in outward)
    assert all(link["href"].startswith("https://example.org/") for link in plain.of("a"))
    assert not plain.of("link")


OFFERED = """
import numpy as np
from qgs_viewer.report import ReportSection, Tile

GREY = np.full((4, 6, 3), 128, np.uint8)

PAGE = '<p title="a">&lt;</p>'

def plugin(shown, samples):
    names = [f"{c.name}: {p[0].gaussians.count} of {samples[0].scene}" for c, p in shown]
    return ReportSection("Mine <b>", "", {"": [Tile(GREY, names[0], page=PAGE)]})
"""


def test_a_distribution_adds_a_section_with_a_page(install):
    install("qgs-mine", "mine", OFFERED, group=GROUP)
    page = page_of(PLAIN, "plain")
    assert "<h2>Mine &lt;b&gt;</h2>" in page
    assert "plain: 32 of test/000000" in page
    found = Elements(page)
    pages = [button["data-page"] for button in found.of("button") if "data-page" in button]
    assert pages == ['<p title="a">&lt;</p>']


@pytest.mark.parametrize(
    "source",
    [
        "import nothing_of_this_name",
        "def plugin(shown, samples):\n    return 'text'",
        OFFERED.replace("Tile(GREY,", "Tile(GREY / 2,"),
        "def plugin(shown, samples):\n    raise SystemExit('gone')",
    ],
)
def test_a_section_that_fails_is_named_and_left_out(install, caplog, source):
    install("qgs-broken", "broken", source, group=GROUP)
    warn_once.cache_clear()
    page = page_of(PLAIN, "plain")
    assert "<h2>A walk through the reconstruction</h2>" in page
    assert "Mine" not in page
    assert "`broken` of qgs-broken 1.2" in caplog.text


def test_large_photos_are_compressed_and_small_ones_exact():
    for side, kind in ((EXACT, "png"), (EXACT + 1, "webp")):
        assert data_uri(np.zeros((side, 9, 3), np.uint8), photo=True).startswith(
            f"data:image/{kind}"
        )
    assert data_uri(np.zeros((EXACT + 1, 9, 3), np.uint8)).startswith("data:image/png")


def test_true_depth_is_in_the_units_of_the_sample():
    recipe = resolve(PLAIN)
    source = recipe.build_data()
    sample = evaluation_samples(source, recipe.views, recipe.evaluation, depths=True)[0]
    own = source.scenes("test")[0].depths(sample.target_frames)
    ratio = sample.targets.depths[0] / own
    assert ratio.min() == pytest.approx(recipe.views.scale_factor, rel=1e-3)
    assert ratio.max() == pytest.approx(recipe.views.scale_factor, rel=1e-3)
