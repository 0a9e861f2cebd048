"""Which device `auto` takes, with and without CUDA and gsplat."""

import pytest
import torch

from qgs.engine import distributed as device
from qgs.engine.distributed import choose_device


@pytest.mark.parametrize(
    ("wanted", "cuda", "gsplat", "expected", "told"),
    [
        ("auto", False, False, "cpu", False),
        ("auto", False, True, "cpu", False),
        ("auto", True, False, "cpu", True),
        ("auto", True, True, "cuda", False),
        ("cpu", True, True, "cpu", False),
        ("cuda", True, False, "cuda", False),
    ],
)
def test_the_device_and_what_is_said(
    monkeypatch: pytest.MonkeyPatch,
    wanted: str,
    cuda: bool,
    gsplat: bool,
    expected: str,
    told: bool,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr(device, "find_spec", lambda name: object() if gsplat else None)
    said: list[str] = []
    assert choose_device(wanted, said.append) == expected
    assert bool(said) == told
    assert not said or "gsplat" in said[0]
