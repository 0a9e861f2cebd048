"""Which kernel computes attention with a bias that is a function, with made-up memory."""

from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
import torch.nn.functional as F
from qgs_locus.kernels import attention_choice
from qgs_locus.kernels.attention_bias import AttentionBias, biased_attention
from qgs_locus.kernels.attention_choice import SHARE, attention_kernel, chosen_kernel, plain_bytes
from torch import Tensor


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
def _small_gpu_with_triton(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attention_choice, "triton_version", lambda: (3, 5))
    _give(monkeypatch, 0)


def _give(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    """A GPU of which a layer may take `size` bytes."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (0, size * SHARE))


PAIRS = 2 * 5 * 7


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


@pytest.mark.parametrize(
    ("version", "options"),
    [
        ((), {}),
        ((3, 2), {}),
        ((3, 10), {"kind": Nearness}),
        ((3, 5), {"width": 300}),
        ((3, 5), {"dtype": torch.float64}),
    ],
)
def test_what_triton_cannot_compute_goes_through_blocks(
    version: tuple[int, ...], options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attention_choice, "triton_version", lambda: version)
    assert _chosen(**options) == "blocks"
    with pytest.raises(ValueError, match="triton"):
        _chosen("triton", **options)


def test_tokens_that_learn_go_through_blocks() -> None:
    q, _, _, bias = _case()
    bias.tokens.requires_grad_()
    on_cuda = cast(Tensor, OnCuda(q))
    assert chosen_kernel(on_cuda, bias, "auto") == "blocks"
    with torch.no_grad():
        assert chosen_kernel(on_cuda, bias, "auto") == "triton"


def test_on_a_cpu_blocks_are_taken_and_triton_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    q, _, _, bias = _case()
    assert chosen_kernel(q, bias, "auto") == "blocks"
    with pytest.raises(ValueError, match="a GPU"):
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
