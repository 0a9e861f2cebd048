"""Files of weights: what is read, and one clear reason for what is not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from qgs.io.checkpoint import CheckpointError
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


def cut(path: Path) -> Path:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def make_cut_safetensors(folder: Path) -> Path:
    save_file({"a": torch.zeros(100)}, folder / "w.safetensors")
    return cut(folder / "w.safetensors")


def make_cut_torch(folder: Path) -> Path:
    torch.save(WEIGHTS, folder / "w.pt")
    return cut(folder / "w.pt")


def make_pickle_called_safetensors(folder: Path, zipped: bool = True) -> Path:
    path = folder / "w.safetensors"
    torch.save(WEIGHTS, path, _use_new_zipfile_serialization=zipped)
    return path


def make_safetensors_called_torch(folder: Path) -> Path:
    save_file(WEIGHTS, folder / "w.pt")
    return folder / "w.pt"


def make_folder(folder: Path) -> Path:
    (folder / "w.safetensors").mkdir()
    return folder / "w.safetensors"


def saved(folder: Path, content: Any) -> Path:
    torch.save(content, folder / "w.pt")
    return folder / "w.pt"


def written(folder: Path, name: str, content: bytes) -> Path:
    (folder / name).write_bytes(content)
    return folder / name


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (make_cut_safetensors, ["not a whole safetensors file", "cut off"]),
        (make_cut_torch, ["not a whole torch file"]),
        (make_pickle_called_safetensors, ["PyTorch (zip) file", "whatever its name says", ".pt"]),
        (lambda f: make_pickle_called_safetensors(f, False), ["a Python pickle"]),
        (make_safetensors_called_torch, ["is a safetensors file", "name it .safetensors"]),
        (make_folder, ["is a folder"]),
        (lambda f: written(f, "w.safetensors", b""), ["is empty"]),
        (lambda f: written(f, "w.pt", b""), ["is empty"]),
        (lambda f: written(f, "w.safetensors", b"0123456789"), ["not a whole safetensors"]),
        (lambda f: written(f, "w.npz", b"0123456789"), ["suffix '.npz'", ".safetensors", ".ckpt"]),
        (lambda f: saved(f, torch.nn.Linear(2, 2)), ["could run code"]),
        (lambda f: saved(f, torch.zeros(2)), ["Tensor, no state dict"]),
        (lambda f: saved(f, {}), ["holds nothing"]),
        (lambda f: saved(f, {"a": torch.zeros(1), "n": 3}), ["no tensors (n)", "none of them"]),
        (lambda f: saved(f, {"model": WEIGHTS, "module": WEIGHTS}), ["more than one"]),
    ],
)
def test_what_cannot_be_read_gets_a_reason(
    tmp_path: Path, make: Callable[[Path], Path], words: list[str]
) -> None:
    path = make(tmp_path)
    with pytest.raises(CheckpointError) as caught:
        read_weight_file(path)
    for part in (str(path), *words):
        assert part in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no weights at .*gone\.pt"):
        read_weight_file(tmp_path / "gone.pt")
