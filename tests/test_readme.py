"""What the README and the pages that it leads to show is what the repository holds."""

import re
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import yaml
from guide_pages import text_of
from photo_formats import centred, synthetic, write_nerfstudio
from qgs_dev import Case, CaseRun
from qgs_viewer.comparison import open_models
from size import ROOT

from qgs.cli import COMMANDS, GROUP
from qgs.recipe.slots import SECTIONS, SLOTS

README = text_of("../README.md")


def test_the_readme_shows_the_overlay_and_paths_that_exist():
    (shown,) = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    recipe = (ROOT / "recipes/locus/overlay.yaml").read_text()
    assert yaml.safe_load(shown) == yaml.safe_load(recipe)
    paths = re.findall(r"[`(](?:\./)?((?:recipes|tools|docs|plugins|tests)/[\w./-]+)[`)]", README)
    assert paths
    assert all((ROOT / path).exists() for path in paths), paths


def test_the_code_of_the_readme_works_on_as_few_photos_as_it_says(here):
    (count,) = re.findall(r"(\d+) photos are enough", README)
    write_nerfstudio(here / "photos", centred(synthetic(here / "noise", int(count))))
    names = {}
    exec("".join(re.findall(r"```python\n(.*?)```", README, re.DOTALL)), names)
    assert Path("scene.ply").is_file()
    CaseRun(Case(names["Near"].Config())).check(["core"])


def test_pages_list_all_slots_with_their_defaults_and_all_commands():
    table = text_of("recipes.md").split("\n## ")[1]
    rows = re.findall(r"^\| `([\w.]+)` \|[^|]*\|([^|]*)\|", table, re.MULTILINE)
    shown = {name.rpartition(".")[2]: re.findall(r"`([^`]+)`", types) for name, types in rows}
    defaults = {name: [slot.default] if slot.default else [] for name, slot in SLOTS.items()}
    defaults |= {name: list(s.defaults.values()) for name, s in SECTIONS.items() if s.defaults}
    assert shown == defaults
    commands = re.findall(r"^- `qgs ([\w-]+)", text_of("commands.md"), re.MULTILINE)
    assert set(commands) == {*COMMANDS, *entry_points(group=GROUP).names}


@pytest.mark.slow
@pytest.mark.parametrize("side", ["64", "128"])
def test_the_models_score_what_the_readme_says(side):
    """By the code of `qgs demo`: crop, renderer and metrics included."""
    of_model = rf"^\| .*?\(`(rooms/.*-{side})`\) \| (\S+) \| (\S+) \| (\S+) \| (\S+) M \|$"
    models = re.findall(of_model, README, re.MULTILINE)
    of_photo = rf"^\| the nearest photo, {side} .*? \| (\S+) \| (\S+) \|"
    (nearest,) = re.findall(of_photo, README, re.MULTILINE)
    given = re.findall(r"(\d+) photos, (\d+) unseen rooms", README)
    assert len(models) >= 2
    results = open_models([model[0] for model in models], None, "cpu")
    for (_, *own, count, size), result in zip(models, results, strict=True):
        for method, (psnr, ssim) in (("model", own), ("nearest_input", nearest)):
            found = result.evaluation.means(method)
            assert abs(found["psnr"] - float(psnr)) <= 0.02
            assert abs(found["ssim"] - float(ssim)) <= 0.002
        scores = result.evaluation.scores
        assert [(f"{len(scores[0].views[0][0])}", f"{len(scores)}")] == given
        assert result.evaluation.gaussians == int(count.replace(",", ""))
        assert f"{result.parameters / 1e6:.2f}" == size
