"""Models by name: those that plugins ship."""

import sys
from pathlib import Path

import pytest
import torch
from commands import done, run_qgs
from photo_formats import put
from safetensors.torch import load_file
from tables import must_refuse, names_in
from training_runs import tiny

import qgs
from qgs.checkpoint.model_file import CheckpointFile, save
from qgs.checkpoint.models import checkpoint_path
from qgs.train.initial import initialise

PLUGIN = """
from qgs.contracts import Plugin
plugin = Plugin("box", 1, (), models={
    "small": "models/small.safetensors",
    "small-1.5": "models/small.safetensors",
    "gone": "models/gone.safetensors",
})
"""


@pytest.fixture
def shipped(install, here):
    """The file of the model box/small; the working directory is empty."""
    install("qgs-box", "box", PLUGIN)
    file = Path(sys.path[0]) / "models/small.safetensors"
    save(tiny("tokengs").build_model(), file, extra={"step": "7"})
    file.with_suffix(".md").write_text("# Small\n\nTiny [rooms],\nin a box.\n\n- Seed: 0\n")
    return file


def test_a_name_stands_for_the_path_wherever_one_is_taken(shipped):
    assert checkpoint_path("box/small") == checkpoint_path("box/small-1.5") == shipped
    assert qgs.load("box/small").recipe == qgs.load(shipped).recipe
    done("eval", "box/small")
    assert Path("evaluation_small/summary.json").is_file()
    done("eval", "box/small")
    assert Path("evaluation_small-2/summary.json").is_file()
    assert names_in(shipped.parent) == {"small.md", shipped.name}
    started = tiny("tokengs", "init_from=box/small")
    assert "weights start from" in initialise(started.build_model(), started)[0]


def test_an_existing_file_of_that_name_wins(shipped):
    put(Path("box/small"), shipped.read_bytes())
    assert checkpoint_path("box/small") == Path("box/small")


def test_models_are_listed_and_checked(shipped):
    result = run_qgs("list")
    assert "box/small" in result.stdout
    assert "Tiny [rooms], in a box." in " ".join(result.stdout.split())
    told = run_qgs("list", "box/small").output
    assert f"{shipped}: 0.3 MB" in told.replace("\n", "")
    assert "- Seed: 0" in told
    assert "no checkpoint at" in str(run_qgs("list", "box/gone").exception)
    checked = run_qgs("check-plugin", "box", "--core")
    assert checked.exit_code == 1
    assert "ok     model box/small" in checked.output
    assert "FAILED model box/gone: no checkpoint at" in checked.output


def test_half_precision_is_stored_and_loads_as_float32(shipped):
    done("export", "box/small", "--half", "--out", "half.safetensors")
    half = load_file("half.safetensors")
    whole = load_file(shipped)
    for name, tensor in half.items():
        assert (tensor.dtype == torch.float16) == whole[name].is_floating_point()
    for name, tensor in qgs.load("half.safetensors").named_parameters():
        assert torch.equal(tensor, whole[name].half().float()), name
    assert CheckpointFile("half.safetensors").step == 7


def test_weights_beyond_half_precision_are_refused(shipped):
    model = qgs.load(shipped)
    model.queries.features.data.fill_(1e6)
    save(model, "large.safetensors")
    words = ("export", "large.safetensors", "--half", "--out", "half.safetensors")
    must_refuse(r"float16 cannot hold .*: queries\.features", done, *words)
    assert not Path("half.safetensors").exists()
