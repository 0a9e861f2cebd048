"""Attention with a bias that is a function: against plain attention, in every number of blocks."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from qgs_locus.kernels import attention_bias
from qgs_locus.kernels.attention_bias import BLOCK, AttentionBias, biased_attention
from torch import Tensor

from qgs.kernels import kernel


class Nearness(AttentionBias):
    """max(-|x - y|^2, lower) of positions x of queries and y of tokens, `lower` of a query."""

    def value(self, queries_nF: Tensor, tokens_GM: Tensor) -> Tensor:
        apart = queries_nF[:, :3, None] - tokens_GM
        bias, lower = -apart.square().sum(1), queries_nF[:, 3:]
        return torch.where(bias > lower, bias, lower)


@kernel
def _write(queries, tokens, out):
    for n in range(queries.shape[0]):
        for j in range(tokens.shape[1]):
            total = np.float32(0)
            for axis in range(3):
                total += (queries[n, axis] - tokens[axis, j]) ** 2
            out[n, j] = max(-total, queries[n, 3])


@kernel
def _gradients(queries, tokens, gradient, out):
    out[:] = 0
    for n in range(queries.shape[0]):
        for j in range(tokens.shape[1]):
            total = np.float32(0)
            for axis in range(3):
                total += (queries[n, axis] - tokens[axis, j]) ** 2
            if -total <= queries[n, 3]:
                out[n, 3] += gradient[n, j]
            else:
                for axis in range(3):
                    out[n, axis] -= 2 * gradient[n, j] * (queries[n, axis] - tokens[axis, j])


class CompiledNearness(Nearness):
    """The same, with kernels."""

    def compiled(self):
        return _write, _gradients


LEAVES = ("q", "k", "v", "positions")


def _case(number: int, lower: float | None = None) -> dict[str, Tensor]:
    """A drawn case: sizes, values, and how many pairs sit at the lower bound."""
    torch.manual_seed(number)
    batch, heads, count, tokens, width = (
        int(torch.randint(1, most, ())) for most in (4, 5, 40, 60, 33)
    )
    bound = -4 * torch.rand(()) if lower is None else torch.tensor(lower)
    positions = torch.cat([torch.randn(batch, count, 3), bound.expand(batch, count, 1)], -1)
    return {
        "q": torch.randn(batch, count, heads, width).transpose(1, 2),
        "k": torch.randn(batch, heads, tokens, width),
        "v": torch.randn(batch, tokens, heads, width).transpose(1, 2),
        "positions": positions,
        "tokens": torch.randn(batch, 3, tokens),
        "gradient": torch.randn(batch, heads, count, width),
    }


def _found(
    case: dict[str, Tensor], kind: type[AttentionBias], plain: bool = False
) -> dict[str, Tensor]:
    """The result and the gradients, through blocks or through all pairs at once."""
    leaves = {name: case[name].detach().clone().requires_grad_() for name in (*LEAVES, "tokens")}
    if kind is CompiledNearness:  # whose kernels give no gradients of tokens
        leaves["tokens"].requires_grad_(False)
    bias = kind(leaves["positions"], leaves["tokens"])
    qkv = leaves["q"], leaves["k"], leaves["v"]
    if plain:
        read = F.scaled_dot_product_attention(*qkv, attn_mask=bias.dense()[:, None])
    else:
        read = biased_attention(*qkv, bias)
    wanted = {name: leaf for name, leaf in leaves.items() if leaf.requires_grad}
    found = torch.autograd.grad(read, list(wanted.values()), case["gradient"])
    return {"read": read, **dict(zip(wanted, found, strict=True))}


def _assert_exact(case: dict[str, Tensor], kind: type[AttentionBias]) -> None:
    """Errors below 1e-5, relative to what is of order 1 or more: the gradient of a bound that all
    pairs reach is a sum of numbers of order 1 that is 0 but for rounding."""
    exact = _found({name: x.double() for name, x in case.items()}, Nearness, plain=True)
    for name, x in _found(case, kind).items():
        error = (x - exact[name]).norm() / exact[name].norm().clamp_min(1)
        assert error < 1e-5, name


@pytest.mark.parametrize("kind", [Nearness, CompiledNearness])
@pytest.mark.parametrize("first", range(0, 200, 50))
def test_gradients_are_those_of_float64(
    first: int, kind: type[AttentionBias], monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(first, first + 50):
        monkeypatch.setitem(BLOCK, "cpu", 4 * (1 + number % 7) * 30)
        monkeypatch.setattr(attention_bias, "_PART", 100)
        _assert_exact(_case(number), kind)


@pytest.mark.parametrize("lower", [0.0, -1e9], ids=["all at the bound", "none"])
@pytest.mark.parametrize("kind", [Nearness, CompiledNearness])
def test_the_bound_holds_for_all_pairs_or_none(lower: float, kind: type[AttentionBias]) -> None:
    case = _case(3, lower)
    _assert_exact(case, kind)
    found = _found(case, kind)
    assert bool((found["positions"][..., :3] == 0).all()) == (lower == 0.0)
    assert bool((found["positions"][..., 3] == 0).all()) == (lower != 0.0)


def test_what_other_devices_compute_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    assert attention_bias._flash_for_cpu() is not None
    monkeypatch.setattr(attention_bias, "_flash_for_cpu", lambda: None)
    _assert_exact(_case(5), Nearness)


def test_bfloat16_comes_back_in_bfloat16_and_the_bias_stays_in_float32() -> None:
    case = _case(7)
    exact = _found({n: x.double() for n, x in case.items()}, Nearness, plain=True)
    halved = {n: x.bfloat16() if n in "qkv" or n == "gradient" else x for n, x in case.items()}
    with torch.autocast("cpu", torch.bfloat16):
        found = _found(halved, Nearness)
    assert found["read"].dtype == found["q"].dtype == torch.bfloat16
    assert found["positions"].dtype == torch.float32
    for name, x in found.items():
        assert (x - exact[name]).norm() < 2e-2 * exact[name].norm(), name


def test_a_pass_without_gradients_comes_before_one_with_them() -> None:
    case = _case(9)
    with torch.inference_mode():
        bias = Nearness(case["positions"], case["tokens"])
        read = biased_attention(case["q"], case["k"], case["v"], bias)
    assert torch.equal(_found(case, Nearness)["read"].detach(), read)


@pytest.mark.parametrize("wanted", [True, False])
def test_tokens_get_gradients_where_they_want_them(wanted: bool) -> None:
    case = _case(11)
    tokens = case["tokens"].requires_grad_(wanted)
    bias = CompiledNearness(case["positions"].requires_grad_(), tokens)
    biased_attention(case["q"], case["k"], case["v"], bias).sum().backward()
    assert (tokens.grad is not None) == wanted
    assert case["positions"].grad is not None


SUBSETS = [
    [name for n, name in enumerate(("q", "k", "v", "positions", "tokens")) if 1 << n & bits]
    for bits in range(1, 2**5)
]


@pytest.mark.parametrize("learnt", SUBSETS, ids=" ".join)
@pytest.mark.parametrize("path", ["blocks", "kernels", "dense"])
def test_what_is_frozen_gets_no_gradient_and_the_others_get_the_same(
    learnt: list[str], path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(BLOCK, "cpu", 4 * 60 * 7)
    monkeypatch.setattr(attention_bias, "_PART", 100)
    kind = CompiledNearness if path == "kernels" else Nearness
    case = _case(13)
    whole = {name for name in case if name != "gradient"}
    if kind is CompiledNearness and "tokens" not in learnt:  # for which torch does the derivative
        whole.remove("tokens")
    made: list[tuple[object, ...]] = []

    def gradients(names: set[str] | list[str]) -> dict[str, Tensor | None]:
        leaves = {n: x.detach().clone().requires_grad_(n in names) for n, x in case.items()}
        q, k, v, positions, tokens = (leaves[n] for n in ("q", "k", "v", "positions", "tokens"))
        kernel = "plain" if path == "dense" else "blocks"
        read = biased_attention(q, k, v, kind(positions, tokens), kernel)
        read.backward(case["gradient"])
        return {name: leaf.grad for name, leaf in leaves.items()}

    expected = gradients(whole)
    of_bias = AttentionBias.gradients
    monkeypatch.setattr(
        AttentionBias, "gradients", lambda *given: made.append(of_bias(*given)) or made[-1]
    )
    for name, found in gradients(learnt).items():
        if name not in learnt:
            assert found is None, name
        elif path == "dense" and name in "qkv" and not {"positions", "tokens"} & {*learnt}:
            torch.testing.assert_close(found, expected[name])  # torch's kernel is another one
        else:
            assert found is not None
            assert torch.equal(found, expected[name]), name
    for of_positions, of_tokens in made:
        assert (of_positions is not None) == ("positions" in learnt)
        assert (of_tokens is not None) == ("tokens" in learnt)
    assert bool(made) == bool({"positions", "tokens"} & {*learnt})


@pytest.mark.parametrize("kind", [Nearness, CompiledNearness])
def test_rows_that_are_asked_for_are_made_alone(
    kind: type[AttentionBias], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows: list[int] = []
    write = AttentionBias.write

    def counting(self: AttentionBias, queries: Tensor, tokens: Tensor, out: Tensor) -> None:
        rows.append(len(queries))
        write(self, queries, tokens, out)

    bias, chosen = kind(torch.randn(2, 9, 4), torch.randn(2, 3, 11)), torch.tensor([7, 2, 7])
    dense = bias.dense()
    monkeypatch.setattr(AttentionBias, "write", counting)
    assert torch.equal(bias.dense(chosen), dense[:, chosen])
    assert rows == [3, 3]
