"""What the README and the pages that it leads to show is what the repository holds."""

import re
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import yaml
from qgs_viewer import contest

from qgs.cli import COMMANDS, GROUP
from qgs.composer.slots import SECTIONS, SLOTS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def test_overlay_is_the_recipe() -> None:
    shown = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    recipe = (ROOT / "recipes/locus/overlay.yaml").read_text(encoding="utf-8")
    assert [yaml.safe_load(text) for text in shown] == [yaml.safe_load(recipe)]


def test_slots_and_their_defaults() -> None:
    rows = re.findall(
        r"^\| `([\w.]+)` \|[^|]*\|([^|]*)\|", page("recipes.md").split("\n## ")[1], re.MULTILINE
    )
    shown = {name.rpartition(".")[2]: re.findall(r"`([^`]+)`", types) for name, types in rows}
    defaults = {name: [slot.default] if slot.default else [] for name, slot in SLOTS.items()}
    defaults |= {name: list(s.defaults.values()) for name, s in SECTIONS.items() if s.named}
    assert shown == defaults


def test_commands() -> None:
    shown = re.findall(r"^\| `qgs ([\w-]+)", page("commands.md"), re.MULTILINE)
    assert set(shown) == {*COMMANDS, *entry_points(group=GROUP).names}


def test_paths_exist() -> None:
    paths = re.findall(r"[`(](?:\./)?((?:recipes|tools|docs|plugins|tests)/[\w./-]+)[`)]", README)
    assert paths
    assert [path for path in paths if not (ROOT / path).exists()] == []


def shown_scores() -> dict[str, list[str]]:
    """PSNR, SSIM, Gaussians and parameters of each model in the README; by the side of photos, "64"
    and "128", PSNR and SSIM of the nearest one.
    """
    rows = re.findall(
        r"^\| .*?\(`(.*?)`\) \| (\S+) \| (\S+) \| (\S+) \| (\S+) M \|$", README, re.MULTILINE
    )
    photos = re.findall(
        r"^\| the nearest photo, (\d+) .*? \| (\S+) \| (\S+) \|", README, re.MULTILINE
    )
    return {model: scores for model, *scores in rows} | {side: scores for side, *scores in photos}


@pytest.mark.slow
@pytest.mark.parametrize(
    "models",
    [
        ("rooms/landmark-64", "rooms/locus-64", "rooms/tokengs-64"),
        ("rooms/landmark-128", "rooms/locus-128"),
    ],
)
def test_the_models_score_what_the_readme_says(models: tuple[str, ...]) -> None:
    """By the code of `qgs demo`: crop, renderer and metrics included."""
    shown = shown_scores()
    entries = contest.judge(contest.checkpoints(models), None, "cpu")
    assert len(entries) == len(models)
    for model, entry in zip(models, entries, strict=True):
        psnr, ssim, count, size = shown[model]
        nearest = shown[model.split("-")[-1]]
        for method, scores in (("model", (psnr, ssim)), ("nearest_input", nearest)):
            found = entry.evaluation.means(method)
            assert found["psnr"] == pytest.approx(float(scores[0]), abs=0.02)
            assert found["ssim"] == pytest.approx(float(scores[1]), abs=0.002)
        assert entry.evaluation.gaussians == int(count.replace(",", ""))
        assert len(entry.evaluation.scores) == 32
        parameters = sum(p.numel() for p in entry.contender.model.parameters())
        assert f"{parameters / 1e6:.2f}" == size
