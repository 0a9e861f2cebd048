"""Files of weights: what is read, and one clear reason for what is not."""

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import torch
from qgs_published.weight_files import read_weight_file
from safetensors.torch import save, save_file
from torch import Tensor

from qgs.io.tensors import CheckpointError

WEIGHTS = {"a.weight": torch.arange(6.0).view(2, 3), "b": torch.tensor(1.5)}


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
        ({"module": WEIGHTS, "optimizer": {"lr": 0.1}}, ["optimizer"]),
    ],
)
def test_where_the_weights_lie_is_told(tmp_path: Path, content: Any, told: list[str]) -> None:
    torch.save(content, tmp_path / "w.pt")
    file = read_weight_file(tmp_path / "w.pt")
    assert_weights(file.tensors)
    for words in told:
        assert any(words in note for note in file.notes), file.notes


def torch_bytes(content: Any, zipped: bool = True) -> bytes:
    buffer = BytesIO()
    torch.save(content, buffer, _use_new_zipfile_serialization=zipped)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("w.safetensors", save(WEIGHTS)[:-5]),
        ("w.pt", torch_bytes(WEIGHTS)[:500]),
        ("w.safetensors", torch_bytes(WEIGHTS)),
        ("w.safetensors", torch_bytes(WEIGHTS, False)),
        ("w.pt", save(WEIGHTS)),
        ("w.safetensors", b""),
        ("w.pt", b""),
        ("w.safetensors", save({})),
        ("w.safetensors", save(WEIGHTS, {"qgs.recipe": "{}"})),
        ("w.npz", b"0123456789"),
        ("w.pt", torch_bytes(torch.nn.Linear(2, 2))),
        ("w.pt", torch_bytes(torch.zeros(2))),
        ("w.pt", torch_bytes({})),
        ("w.pt", torch_bytes({"a": torch.zeros(1), "n": 3})),
        ("w.pt", torch_bytes({"model": WEIGHTS, "module": WEIGHTS})),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=str(path)):
        read_weight_file(path)
    with pytest.raises(FileNotFoundError):
        read_weight_file(tmp_path)


@pytest.mark.parametrize("key", ["model", "state_dict"])
def test_a_dict_that_holds_itself(tmp_path: Path, key: str) -> None:
    content: dict[str, Any] = {"w": torch.zeros(2)}
    content[key] = content
    torch.save(content, tmp_path / "w.pt")
    with pytest.raises(CheckpointError, match="too deep"):
        read_weight_file(tmp_path / "w.pt")
