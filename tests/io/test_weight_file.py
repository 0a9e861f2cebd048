"""Files of weights: what is read, and one clear reason for what is not."""

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save, save_file
from torch import Tensor

from qgs.io.tensors import CheckpointError
from qgs.io.weight_file import read_weight_file

WEIGHTS = {"a.weight": torch.arange(6.0).view(2, 3), "b": torch.tensor(1.5)}
BEHIND_DDP = {f"module.{name}": tensor for name, tensor in WEIGHTS.items()}


def assert_weights(tensors: Mapping[str, Tensor]) -> None:
    assert tensors.keys() == WEIGHTS.keys()
    assert all(torch.equal(tensors[name], tensor) for name, tensor in WEIGHTS.items())


def test_safetensors(tmp_path: Path) -> None:
    save_file(WEIGHTS, tmp_path / "w.safetensors")
    file = read_weight_file(tmp_path / "w.safetensors")
    assert_weights(file.tensors)
    assert file.notes == ()


@pytest.mark.parametrize("suffix", ["pt", "pth", "bin", "ckpt", "PT"])
@pytest.mark.parametrize("zipped", [True, False])
def test_torch_files(tmp_path: Path, suffix: str, zipped: bool) -> None:
    path = tmp_path / f"w.{suffix}"
    torch.save(WEIGHTS, path, _use_new_zipfile_serialization=zipped)
    assert_weights(read_weight_file(path).tensors)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({"model": WEIGHTS}, ["'model'"]),
        ({"state_dict": WEIGHTS, "epoch": 3}, ["'state_dict'", "epoch"]),
        ({"state_dict": {"module": WEIGHTS}}, ["'state_dict'", "'module'"]),
        ({"module": BEHIND_DDP, "optimizer": {"lr": 0.1}}, ["optimizer", "'module.' off all 2"]),
        (BEHIND_DDP, ["'module.' off all 2"]),
    ],
)
def test_where_the_weights_lie_is_told(tmp_path: Path, content: Any, told: list[str]) -> None:
    torch.save(content, tmp_path / "w.pt")
    file = read_weight_file(tmp_path / "w.pt")
    assert_weights(file.tensors)
    for words in told:
        assert any(words in note for note in file.notes), file.notes


def test_a_prefix_that_only_some_names_have_stays(tmp_path: Path) -> None:
    mixed = {"module.a": torch.ones(1), "b": torch.ones(1)}
    save_file(mixed, tmp_path / "w.safetensors")
    assert read_weight_file(tmp_path / "w.safetensors").tensors.keys() == mixed.keys()


def torch_bytes(content: Any, zipped: bool = True) -> bytes:
    buffer = BytesIO()
    torch.save(content, buffer, _use_new_zipfile_serialization=zipped)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("w.safetensors", save(WEIGHTS)[:-5], ["not a whole safetensors file", "cut off"]),
        ("w.pt", torch_bytes(WEIGHTS)[:500], ["not a whole torch file"]),
        ("w.safetensors", torch_bytes(WEIGHTS), ["PyTorch (zip) file", "whatever", "name it .pt"]),
        ("w.safetensors", torch_bytes(WEIGHTS, False), ["a Python pickle"]),
        ("w.pt", save(WEIGHTS), ["is a safetensors file", "name it .safetensors"]),
        ("w.safetensors", None, ["is a folder"]),
        ("w.safetensors", b"", ["is empty"]),
        ("w.pt", b"", ["is empty"]),
        ("w.safetensors", b"0123456789", ["not a whole safetensors"]),
        ("w.safetensors", save({}), ["holds no tensors"]),
        ("w.safetensors", save(WEIGHTS, {"qgs.recipe": "{}"}), ["is a qgs checkpoint"]),
        ("w.npz", b"0123456789", ["suffix '.npz'", ".safetensors", ".ckpt"]),
        ("w.pt", torch_bytes(torch.nn.Linear(2, 2)), ["could run code"]),
        ("w.pt", torch_bytes(torch.zeros(2)), ["Tensor, no state dict"]),
        ("w.pt", torch_bytes({}), ["holds nothing"]),
        ("w.pt", torch_bytes({"a": torch.zeros(1), "n": 3}), ["no tensors (n)", "none of them"]),
        ("w.pt", torch_bytes({"model": WEIGHTS, "module": WEIGHTS}), ["more than one"]),
    ],
)
def test_what_cannot_be_read_gets_a_reason(
    tmp_path: Path, name: str, content: bytes | None, words: list[str]
) -> None:
    path = tmp_path / name
    path.mkdir() if content is None else path.write_bytes(content)
    with pytest.raises(CheckpointError) as caught:
        read_weight_file(path)
    for part in (str(path), *words):
        assert part in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no weights at .*gone\.pt"):
        read_weight_file(tmp_path / "gone.pt")
