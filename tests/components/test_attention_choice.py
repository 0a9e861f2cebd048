"""Which kernel computes attention with a bias that is a function, with made-up memory."""

import logging
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.components import AttentionBias, attention_choice
from qgs.components.attention_bias import biased_attention
from qgs.components.attention_choice import SHARE, attention_kernel, chosen_kernel, plain_bytes


class Nearness(AttentionBias):
    """-|x - y|^2 of positions x of queries and y of tokens."""

    def value(self, queries_nF: Tensor, tokens_GM: Tensor) -> Tensor:
        return -(queries_nF[:, :, None] - tokens_GM).square().sum(1)


class InTriton(Nearness):
    """The same, with functions that nothing calls here."""

    def triton_functions(self) -> tuple[Any, Any]:
        return object(), object()


def _case(
    kind: type[AttentionBias] = InTriton, dtype: torch.dtype = torch.float32, width: int = 8
) -> tuple[Tensor, Tensor, Tensor, AttentionBias]:
    q, k, v = (torch.randn(2, 3, count, width, dtype=dtype) for count in (5, 7, 7))
    return q, k, v, kind(torch.randn(2, 5, 3, requires_grad=True), torch.randn(2, 3, 7))


class OnCuda:
    """A tensor, as far as the choice looks, that says it is on CUDA."""

    def __init__(self, x: Tensor) -> None:
        self.shape, self.dtype, self.element_size = x.shape, x.dtype, x.element_size
        self.device = SimpleNamespace(type="cuda")


def _chosen(kernel: Any = "auto", **options: Any) -> str:
    q, _, _, bias = _case(**options)
    return chosen_kernel(cast(Tensor, OnCuda(q)), bias, kernel)


@pytest.fixture(autouse=True)
def _nothing_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attention_choice, "_said", set())
    _install(monkeypatch, "3.5.0")
    _give(monkeypatch, 0)


def _give(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    """A GPU of which a layer may take `size` bytes."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (0, size * SHARE))


def _install(monkeypatch: pytest.MonkeyPatch, version: str | None) -> None:
    spec = None if version is None else object()
    monkeypatch.setattr(attention_choice, "find_spec", lambda name: spec)
    module = SimpleNamespace(__version__=version)
    monkeypatch.setattr(attention_choice, "import_module", lambda name: module)


PAIRS = 2 * 5 * 7
INSTALL = 'run `pip install "query-gaussians[triton]"`'


@pytest.mark.parametrize(
    ("dtype", "trains", "needed"),
    [
        (torch.float32, True, PAIRS * (4 + 3 * 4)),
        (torch.bfloat16, True, PAIRS * (4 + 2 + 3 * 2)),
        (torch.float32, False, PAIRS * 4),
    ],
)
def test_the_plain_path_is_taken_while_it_fits(
    dtype: torch.dtype, trains: bool, needed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with torch.set_grad_enabled(trains):
        q, *_, bias = _case(dtype=dtype)
        assert plain_bytes(q, bias) == needed
        _give(monkeypatch, needed)
        assert _chosen(dtype=dtype) == "plain"
        _give(monkeypatch, needed - 1)
        assert _chosen(dtype=dtype) == "triton"


def test_it_says_once_what_does_not_fit(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert [_chosen(), _chosen()] == ["triton", "triton"]
    assert caplog.messages == [
        "attention of 5 queries to 7 tokens (batch 2, 3 heads) would take 1.12 kB for the bias of "
        "all pairs and its gradient, more than 1/16 of the GPU's memory: it goes through Triton "
        "kernels"
    ]


@pytest.mark.parametrize(
    ("version", "options", "why"),
    [
        (None, {}, f"it needs triton 3.5 or newer (none is installed): {INSTALL}"),
        ("3.2.0", {}, f"it needs triton 3.5 or newer (3.2.0 is installed): {INSTALL}"),
        ("3.10.1", {"kind": Nearness}, "Nearness brings no functions for it (`triton_functions`)"),
        ("3.5.0", {"width": 300}, "its heads are at most 256 wide, not 300"),
        (
            "3.5.0",
            {"dtype": torch.float64},
            "it takes float32, bfloat16 and float16, not torch.float64",
        ),
    ],
)
def test_without_triton_it_goes_through_blocks_and_says_why(
    version: str | None,
    options: dict[str, Any],
    why: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    _install(monkeypatch, version)
    assert _chosen(**options) == "blocks"
    assert caplog.messages[0].endswith(f"blocks in torch, slower than Triton: {why}")
    with pytest.raises(ValueError, match="the Triton kernel of attention cannot be used") as error:
        _chosen("triton", **options)
    assert str(error.value).endswith(why)


def test_tokens_that_learn_go_through_blocks(caplog: pytest.LogCaptureFixture) -> None:
    q, _, _, bias = _case()
    bias.tokens.requires_grad_()
    on_cuda = cast(Tensor, OnCuda(q))
    assert chosen_kernel(on_cuda, bias, "auto") == "blocks"
    assert "no gradients of what the bias reads of tokens" in caplog.text
    with torch.no_grad():
        assert chosen_kernel(on_cuda, bias, "auto") == "triton"


def test_on_a_cpu_blocks_are_taken_and_triton_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    q, _, _, bias = _case()
    assert chosen_kernel(q, bias, "auto") == "blocks"
    with pytest.raises(ValueError, match="it runs on a GPU, and the tensors are on cpu"):
        biased_attention(*_case(), "triton")


def test_a_kernel_is_forced_through_the_whole_model() -> None:
    with attention_kernel("plain"):
        assert _chosen() == "plain"
        assert _chosen("blocks") == "blocks"
        with attention_kernel("blocks"):
            assert _chosen() == "blocks"
        assert _chosen() == "plain"
    assert _chosen() == "triton"


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_plain_path_computes_the_same(dtype: torch.dtype) -> None:
    q, k, v, bias = _case(dtype=dtype)
    plain = biased_attention(q, k, v, bias, "plain")
    assert plain.dtype == dtype
    mask = bias.dense()[:, None].to(dtype)
    assert torch.equal(plain, F.scaled_dot_product_attention(q, k, v, attn_mask=mask))
    tolerance = 1e-6 if dtype == torch.float32 else 3e-2
    torch.testing.assert_close(
        plain, biased_attention(q, k, v, bias), rtol=tolerance, atol=tolerance
    )
