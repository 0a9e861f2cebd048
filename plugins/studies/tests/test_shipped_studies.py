"""The studies that come with qgs: each composes, at both sizes, from the same changes."""

from pathlib import Path

import leave_one_scene_out
import pytest
from qgs_studies.plan import composed, differences, planned
from qgs_studies.study import read_study

from qgs.composer import resolve

RECIPES = Path(__file__).parents[3] / "recipes"
STUDIES = RECIPES / "studies"
FILES = sorted(path.relative_to(STUDIES).as_posix() for path in STUDIES.rglob("*.yaml"))
BOTH = sorted({p.name for p in STUDIES.glob("tiny/*")} & {p.name for p in STUDIES.glob("pub*/*")})


@pytest.mark.parametrize("file", FILES)
def test_every_study_composes(file: str, tmp_path: Path) -> None:
    study = read_study(STUDIES / file)
    recipes = composed(study)
    told = [text for recipe in recipes.values() for text in recipe.warnings]
    assert all("schedules count steps" in text for text in told), "beside a time budget"
    assert study.settings.hypotheses
    if file.startswith("tiny"):
        assert len(planned(study, tmp_path / "out").runs) >= 6


@pytest.mark.parametrize("name", BOTH)
def test_both_sizes_ask_the_same(name: str) -> None:
    tiny, published = (read_study(STUDIES / size / name) for size in ("tiny", "published"))
    assert tiny.variants.keys() == published.variants.keys()
    claims = [hypothesis.claim for hypothesis in published.settings.hypotheses]
    assert [h.claim for h in tiny.settings.hypotheses][: len(claims)] == claims


def test_the_ablations_of_published_size_are_the_recipes_of_the_tables() -> None:
    for study, prefix, names in (
        ("structural", "", {}),
        ("supervised_layers", "supervised_", {"half_and_last": "6_12", "last": "12"}),
    ):
        recipes = composed(read_study(STUDIES / "published" / f"{study}.yaml"))
        names = {**{name: name for name in recipes}, **names, "four": "3_6_9_12"}
        for name, recipe in recipes.items():
            table = resolve(RECIPES / "ablations" / f"{prefix}{names[name]}.yaml")
            paths = differences(recipe, table)
            assert {path.split(".")[0] for path in paths} <= {"data", "evaluation"}, paths


def test_the_table_of_scenes_left_out_compares_the_same_seeds(tmp_path: Path) -> None:
    """LocusGS has a third seed, a lucky one, and of the second scene alone there are results."""

    def judge(run: str, psnr: str) -> None:
        folder = tmp_path / run.replace("/", "/study/runs/", 1) / "evaluation"
        folder.mkdir(parents=True)
        head = "scene,model_psnr,nearest_input_psnr,mean_colour_psnr"
        (folder / "scenes.csv").write_text(f"{head}\nw0,{psnr},9.0,7.0\n")
        (folder / "protocol.json").write_text("{}")

    scores = {"locus": ("10.0", "12.0", "20.0"), "tokengs": ("11.0", "13.0")}
    for variant, values in scores.items():
        for seed, value in enumerate(values):
            judge(f"desk/{variant}/seed-{seed}", value)
    judge("walk/locus/seed-0", "14.0")
    assert leave_one_scene_out.table_rows(tmp_path) == [
        ["scene left out", "locus", "tokengs", "nearest input", "mean colour", "seeds"],
        ["desk", "11.00", "12.00", "9.00", "7.00", "0, 1"],
        ["walk", "14.00", "", "9.00", "7.00", "0"],
        ["mean of full rows", "11.00", "12.00", "9.00", "7.00", ""],
    ]
    judge("walk/tokengs/seed-0", "")
    with pytest.raises(ValueError, match="model_psnr"):
        leave_one_scene_out.table_rows(tmp_path)
