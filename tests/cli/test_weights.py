"""`qgs import` and `qgs export`: what is told, and exit code 2 for wrong files."""

import sys
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import pytest
import torch
from golden_weights import published
from safetensors.torch import load_file, save, save_file
from training_runs import same

import qgs
from qgs.cli import main

LOCUS = published("locus_full_a")
HALF = save({name: tensor.half() for name, tensor in LOCUS.items()})


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """`run("import", ..., code=0)`: what the command tells; the exit code is checked."""

    def call(*words: object, code: int = 0) -> str:
        monkeypatch.setattr(sys, "argv", ["qgs", *map(str, words)])
        with pytest.raises(SystemExit) as stopped:
            main()
        assert (stopped.value.code or 0) == code
        told = capsys.readouterr()
        return told.err if code else told.out

    return call


@pytest.fixture
def locus(tmp_path: Path) -> Path:
    save_file(LOCUS, tmp_path / "locus.safetensors")
    return tmp_path / "locus.safetensors"


def test_there_and_back(run: Callable[..., str], locus: Path, tmp_path: Path) -> None:
    out, back = tmp_path / "c.safetensors", tmp_path / "back.safetensors"
    told = run("import", locus, "--recipe", "auto", "--out", out)
    assert "LocusGS (leo-frank/LocusGS): 109 tensors used" in told
    assert "  enc_dec_backbone.decoder_blocks.1.gs_cross_attn.tau_sample\n" in told
    assert "bandwidth of the ray bias" in told
    assert "# " in out.with_suffix(".yaml").read_text(encoding="utf-8")
    assert qgs.load(out).depth == 2
    told = run("export", out, "--layout", "published", "--out", back)
    assert "109 tensors written" in told
    assert "strict=False" in told
    again = tmp_path / "again.safetensors"
    run("import", back, "--recipe", out.with_suffix(".yaml"), "--out", again)
    assert "knowingly dropped" not in told
    assert same(qgs.load(out).state_dict(), qgs.load(again).state_dict())


def test_latents_there_and_back(run: Callable[..., str], tmp_path: Path) -> None:
    given, out, back = (tmp_path / f"{name}.safetensors" for name in ("given", "ours", "back"))
    save_file(published("tokengs_latent_a"), given)
    told = run("import", given, "--recipe", "auto", "--out", out)
    assert "TokenGS (nv-tlabs/TokenGS): 177 tensors used" in told
    assert "blocks that an encoder of 2026.6 reads: every second one" in told
    model = qgs.load(out)
    assert model.recipe["views"]["frame"] == "mean_cam"
    assert model.recipe["model"]["encoder"]["blocks"] == [2, 4]
    run("export", out, "--layout", "published", "--out", back)
    assert same(load_file(back), load_file(given))


def test_set_changes_the_recipe(run: Callable[..., str], locus: Path, tmp_path: Path) -> None:
    run("import", locus, "--recipe", "auto", "--out", tmp_path / "c.safetensors")
    options = ("--recipe", tmp_path / "c.yaml", "--out", tmp_path / "d.safetensors")
    told = run("import", locus, *options, "--set", "model.head.gaussians_per_query=5", code=2)
    assert "model.head.gaussians_per_query: 4 (the recipe has 5)" in told
    assert "shape of activation_head.deconv.weight: (56, 64) in the file, (70, 64)" in told
    run("import", locus, *options, "--set", "model.head.scale_cap=0.1")
    recipe = qgs.load(tmp_path / "d.safetensors").recipe
    assert recipe is not None
    assert recipe["model"]["head"]["scale_cap"] == 0.1


def torch_file() -> bytes:
    buffer = BytesIO()
    torch.save(LOCUS, buffer)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (HALF, "float16"),
        (save(published("tokengs_a")), "weights of TokenGS"),
        (save(LOCUS | {"extra.bias": torch.zeros(4)}), "unexpected: extra.bias"),
        (torch_file(), "PyTorch (zip) file"),
        (save(LOCUS)[:-1000], "not a whole safetensors file"),
    ],
    ids=["half", "TokenGS", "extra", "pickle", "cut off"],
)
def test_wrong_files_end_with_one_error_and_leave_nothing(
    run: Callable[..., str], locus: Path, tmp_path: Path, content: bytes, words: str
) -> None:
    run("import", locus, "--recipe", "auto", "--out", tmp_path / "c.safetensors")
    wrong, out = tmp_path / "wrong.safetensors", tmp_path / "new" / "x.safetensors"
    wrong.write_bytes(content)
    before = sorted(tmp_path.iterdir())
    told = run("import", wrong, "--recipe", tmp_path / "c.yaml", "--out", out, code=2)
    assert told.count("error:") == 1
    assert words in told
    assert sorted(tmp_path.iterdir()) == before


def test_half_precision_on_demand(run: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "h.safetensors").write_bytes(HALF)
    told = run(
        "import", tmp_path / "h.safetensors", "--recipe", "auto", "--to-float32",
        "--out", tmp_path / "c.safetensors",
    )  # fmt: skip
    assert "converted to float32: 109 of 109 are float16" in told


def test_auto_takes_overrides_and_no_checkpoint_for_its_recipe(
    run: Callable[..., str], locus: Path, tmp_path: Path
) -> None:
    told = run("import", locus, "--recipe", "auto", "--out", tmp_path / "c.yaml", code=2)
    assert "name it .safetensors" in told
    assert sorted(tmp_path.iterdir()) == [locus]
    out, option = tmp_path / "c.safetensors", "model.head.scale_cap=0.1"
    told = run("import", locus, "--recipe", "auto", "--out", out, "--set", option)
    assert "model.head.scale_cap: 0.1 (LocusGS: 0.075)" in told
    recipe = qgs.load(out).recipe
    assert recipe is not None
    assert recipe["model"]["head"]["scale_cap"] == 0.1
