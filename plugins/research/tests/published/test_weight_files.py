"""Files of weights: what is read, and one clear reason for what is not."""

from io import BytesIO

import torch
from qgs_research.published.importing import read_weight_file
from safetensors.torch import save
from tables import assert_equal, must_not_find, must_refuse

from qgs.checkpoint.tensors import CheckpointError

WEIGHTS = {"a.weight": torch.arange(6.0).view(2, 3), "b": torch.tensor(1.5)}
SAFE = save(WEIGHTS)


def torch_bytes(content, zipped=True):
    buffer = BytesIO()
    torch.save(content, buffer, _use_new_zipfile_serialization=zipped)
    return buffer.getvalue()


FLAT = torch_bytes(WEIGHTS)
OLD = torch_bytes(WEIGHTS, zipped=False)


def read(path, content, notes):
    path.write_bytes(content)
    return read_weight_file(path, notes)


def test_weights_are_read_and_where_they_lay_is_told(tmp_path):
    training = {"state_dict": WEIGHTS, "epoch": 3}
    for name, content, told in (
        ("w.safetensors", SAFE, []),
        *((f"w.{suffix}", FLAT, []) for suffix in ("pt", "pth", "bin", "ckpt", "PT")),
        ("w.pt", OLD, []),
        ("w.pt", torch_bytes({"model": WEIGHTS}), ["'model'"]),
        ("w.pt", torch_bytes(training), ["'state_dict'; left out: epoch"]),
        ("w.pt", torch_bytes({"state_dict": {"module": WEIGHTS}}), ["'state_dict'", "'module'"]),
        ("w.pt", torch_bytes({"module": WEIGHTS, "lr": {"a": 0.1}}), ["'module'; left out: lr"]),
    ):
        notes = []
        assert_equal(read(tmp_path / name, content, notes), WEIGHTS)
        assert notes == [f"the weights are below the key {what}" for what in told]


def test_what_cannot_be_read_is_named(tmp_path):
    checkpoint = save(WEIGHTS, {"qgs.recipe": "{}"})
    mixed = {"a": torch.zeros(1), "n": 3}
    twice = {"model": WEIGHTS, "module": WEIGHTS}
    endless = {"w": torch.zeros(2)}
    endless["model"] = endless
    objects = (torch.nn.Linear(2, 2), torch.zeros(2), {}, mixed, twice, endless)
    for name, contents in {
        "w.safetensors": (SAFE[:-5], FLAT, OLD, b"", save({}), checkpoint),
        "w.pt": (FLAT[:500], SAFE, b"", *map(torch_bytes, objects)),
        "w.npz": (b"0123456789",),
    }.items():
        for content in contents:
            path = tmp_path / name
            must_refuse(str(path), read, path, content, [], kind=CheckpointError)
    must_not_find("", read_weight_file, tmp_path, [])
