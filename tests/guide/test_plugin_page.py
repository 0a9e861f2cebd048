"""The code of "Write a plugin in 15 minutes", without an installation.

The slow tests in tests/outside type every command of the page in a fresh environment.
"""

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
import torch
from guide_pages import blocks
from qgs_locus.cross_attention import RayBiasedCrossAttention
from qgs_plugintools import Case, cases_of, checks_for, run_check
from qgs_plugintools.inputs import inputs_of
from qgs_plugintools.new_command import rendered
from training_runs import run

from qgs.composer import RecipeError, registry
from qgs.composer.recipe import resolve
from qgs.composer.registry import InstalledPlugin, load_plugin
from qgs.contracts import ModelDims
from qgs.types import QueryState

PACKAGE = "qgs_sightline"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The distribution as it is at the end of the page."""
    folder = tmp_path_factory.mktemp("qgs-sightline")
    files = {str(path): text for path, text in rendered("sightline")}
    for kind in ("python", "yaml"):
        for title, text in blocks("plugin.md", kind).items():
            verb, _, path = title.partition(": ")
            if path:
                assert (path in files) == (verb == "change"), f"{title}: new or changed?"
                files[path] = text
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text, encoding="utf-8")
    return folder


@pytest.fixture
def package(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(folder / "src")
    yield import_module(PACKAGE)
    for name in [name for name in sys.modules if name.partition(".")[0] == PACKAGE]:
        del sys.modules[name]


def test_the_page_shows_what_new_plugin_writes() -> None:
    written = {str(path): text for path, text in rendered("sightline")}
    code = blocks("plugin.md", "python")
    shown = {title: text for title, text in code.items() if ":" not in title}
    assert len(shown) == 3, "the component, the plugin and the test"
    assert {title: written[title] for title in shown} == shown
    assert blocks("plugin.md", "toml").popitem()[1] in written["pyproject.toml"]


@pytest.mark.parametrize("number", range(8))
def test_components_keep_their_contracts(package: ModuleType, number: int) -> None:
    cases = cases_of(InstalledPlugin(package.plugin))
    assert len(cases) == 8, "one of each component, and one more of its examples"
    case = cases[number]
    outcomes = [run_check(check, case) for check in checks_for(case, ["core"])]
    assert [outcome.message for outcome in outcomes if outcome.verdict == "failed"] == []


def test_the_field_starts_changes_and_places(package: ModuleType) -> None:
    dims = ModelDims(16, 2, 1)
    depth = package.depth
    queries = depth.DepthQueries(depth.DepthQueries.Config(count=4), dims)
    refinement = depth.DepthRefinement(depth.DepthRefinement.Config(), dims)
    centers = depth.DepthCenters(depth.DepthCenters.Config(), dims)
    state = refinement(queries.start(2))
    learned = queries.log_depth + refinement.step(queries.features)
    means = centers(torch.zeros(2, 4, 1, 3), state)
    torch.testing.assert_close(means[1, :, 0, 2:], learned.clamp(-4, 4).exp())
    assert not means[..., :2].any()


def test_what_the_page_says_is_refused(
    folder: Path, package: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert resolve("depth.yaml", plugins=[package.plugin])
    needed = r"`sightline/deepen` needs sightline\.log_depth .*\n  fix: use `sightline/deep`"
    with pytest.raises(RecipeError, match=needed):
        resolve("depth.yaml", ["model.queries.type=qgs/latent"], plugins=[package.plugin])
    with pytest.raises(RecipeError, match="far must be more than near, 9\n  fix: set it farther"):
        resolve("frustum.yaml", ["model.centers.near=9"], plugins=[package.plugin])


def test_the_second_component_computes_its_formula(package: ModuleType) -> None:
    config = package.FrustumCenters.Config(near=0.5, far=8.0, slope=2.0)
    centers = package.FrustumCenters(config, ModelDims(16, 2, 1))
    state = QueryState(torch.zeros(1, 1, 16))
    middle, corner = centers(torch.tensor([[[[0.0, 0.0, 0.0], [50.0, -50.0, 50.0]]]]), state)[0, 0]
    assert middle.tolist() == [0.0, 0.0, 2.0], "depth is the geometric mean of near and far"
    assert corner.tolist() == [16.0, -16.0, 8.0], "the far corner of the frustum"


def test_the_recipes_work(
    folder: Path, package: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    recipe = resolve("frustum.yaml", plugins=[package.plugin])
    assert recipe.tree["model"]["centers"]["type"] == "sightline/frustum"
    assert recipe.tree["model"]["decoder"]["cross_attention"]["type"] == "sightline/abstaining"
    model = recipe.build_model("meta")
    assert isinstance(model.centers, package.FrustumCenters)


def test_every_second_head_reads_close_rays_alone_and_says_so(
    folder: Path, package: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    recipe = resolve("nearby.yaml", plugins=[package.plugin])
    assert set(recipe.tree["plugins"]) == {"locus", "sightline", "rooms"}
    case = Case(package.NearbyAttention.Config(reach=0.5))
    inputs, attention = inputs_of(case), case.build()
    with torch.no_grad():
        explained = attention.explain(*inputs.values(), torch.arange(6))
        shared = RayBiasedCrossAttention.bias(attention, *inputs.values()).dense()
    assert torch.equal(explained.geometry[:, 0], shared)
    hidden = explained.geometry[:, 1].isinf()
    kept = shared >= -0.5 * attention.gamma * 0.25
    assert hidden.any()
    assert (~hidden).any(-1).all()
    assert not (hidden & kept).any()
    assert (explained.weights[:, 1][hidden] == 0).all()


def test_the_encoder_trains(
    folder: Path, package: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(folder)
    fewer = ["training.steps=3", "optimizer.warmup=1"]
    recipe = resolve("cnn.yaml", fewer, plugins=[package.plugin])
    installed = {"sightline": InstalledPlugin(package.plugin)}
    monkeypatch.setattr(registry, "load_plugin", lambda n: installed.get(n) or load_plugin(n))
    start = recipe.build_model("cpu").encoder
    result = run(recipe, tmp_path / "run")
    learned = result.model.encoder
    assert isinstance(learned, package.ConvolutionalEncoder)
    changes = [p - q for p, q in zip(learned.parameters(), start.parameters(), strict=True)]
    assert all(0 < x.abs().max() < 0.1 for x in changes)
