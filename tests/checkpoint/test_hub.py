"""Checkpoints on the Hugging Face Hub, of which a folder takes the place."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from huggingface_hub import HfApi
from photo_formats import put
from tables import assert_equal, contents, must_refuse, names_in
from training_runs import tiny

import qgs
from qgs.checkpoint.hub import SCORES
from qgs.domain import KEY, Domain


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """Uploads go into folders of the repositories' names."""

    def upload_folder(_, repo_id, folder_path, **told):
        assert told["revision"] == "v1"
        return str(shutil.copytree(folder_path, tmp_path / "hub" / repo_id))

    monkeypatch.setattr(
        HfApi, "create_repo", lambda _, repo_id, **told: SimpleNamespace(repo_id=repo_id)
    )
    monkeypatch.setattr(HfApi, "upload_folder", upload_folder)


def test_a_model_comes_back_and_its_card_says_what_the_checkpoint_knows(hub, tmp_path):
    run = tmp_path / "run"
    model = tiny("locus").build_model()
    seen = Domain(yaml.safe_load("{views: [2.0, 4.0], fov: [50.0, 61.0]}"), samples=2)
    qgs.save(model, run / "checkpoint.safetensors", extra={"step": "1200", KEY: seen.text})
    put(run / SCORES, b"| method | PSNR |\n")
    url = qgs.push_to_hub(run, "me/locus", license="apache-2.0", branch="v1")
    pushed = Path(url)
    assert_equal(qgs.from_pretrained(url).state_dict(), model.state_dict())

    assert names_in(pushed) == {"README.md", "config.json", "checkpoint.safetensors"}
    _, data, text = (pushed / "README.md").read_text().split("---\n", 2)
    assert yaml.safe_load(data)["license"] == "apache-2.0"
    for told in (
        'qgs.from_pretrained("me/locus")',
        "pip install query-gaussians query-gaussians-locus query-gaussians-worlds",
        "there are 2 to 4 input views",
        "| method | PSNR |",
        "Trained for 1,200 steps",
        "type: locus/refine",
    ):
        assert told in text
    # nobody else needs to know where the run lies
    assert not any(str(tmp_path).encode() in file for file, _ in contents(pushed).values())
    (run / SCORES).write_text("of https://me:secret@host/model")
    must_refuse("a password", qgs.push_to_hub, run, "me/locus", license="apache-2.0")


def test_a_model_that_ships_keeps_its_card(hub):
    url = qgs.push_to_hub("rooms/locus-64", "me/rooms", license="apache-2.0", branch="v1")
    assert "procedural rooms" in (Path(url) / "README.md").read_text()
    assert qgs.from_pretrained(url).trained_on.values
