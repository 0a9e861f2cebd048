"""What docs/scale.md says of the cost of trainings is what tools/count_cost.py counts."""

import re
from pathlib import Path

import pytest
from count_cost import OF_MILLION, PAPER, Cost, count, print_counts, print_growth, print_memory
from qgs_bench.predict import need_of
from qgs_bench.work import workload_of

from qgs.composer import resolve

PAGE = (Path(__file__).parents[1] / "docs" / "scale.md").read_text(encoding="utf-8")


def by_hand(cost: Cost, queries: int) -> float:
    """FLOPs of linear layers and attention in a forward pass of TokenGS at published size."""
    height, width = cost.size
    tokens, dim = cost.recipe.views.inputs * height * width // 64, 1024
    encoder = 3 * (24 * tokens * dim**2 + 4 * tokens**2 * dim) + 4 * tokens * dim**2
    patches = 2 * tokens * (3 + 6) * 64 * dim
    decoder = 28 * queries * dim**2 + 4 * queries * (tokens + queries) * dim
    return encoder + patches + 12 * decoder + 2 * queries * dim * 64 * 14


def test_flops_are_those_of_the_formulas() -> None:
    cost = count("tokengs/re10k.yaml")
    assert cost.forward == pytest.approx(by_hand(cost, 1024), rel=1e-3)
    assert cost.backward > 2 * cost.forward  # twice, and the products of attention once more
    more = count("tokengs/re10k.yaml", ["model.queries.count=2048"])
    assert more.forward == pytest.approx(by_hand(more, 2048), rel=1e-3)
    assert more.parameters == cost.parameters + 1024 * 1024


def test_a_bias_is_counted_as_attention_is() -> None:
    plain = count("locus/re10k.yaml", ["model.decoder.cross_attention={type: qgs/content}"])
    biased = count("locus/re10k.yaml")
    assert biased.forward == pytest.approx(plain.forward, rel=1e-3)
    assert biased.backward == pytest.approx(plain.backward, rel=1e-3)
    assert (plain.pairs, biased.pairs) == (0, 12 * 1024 * 2048)


@pytest.mark.slow
def test_memory_is_what_qgs_bench_predicts() -> None:
    small = ["model.width=32", "model.heads=2", "model.queries.count=12"]
    name, changes = "tiny/locus.yaml", ["data.image_size=[16, 24]", *small]
    cost, recipe = count(name, changes), resolve(name, changes)
    work = workload_of(recipe, batch=3, device="cuda", precision="bf16")
    need, buckets = need_of(recipe, work), 4 * cost.parameters
    apart = abs(cost.memory(3) - need.total - buckets)
    assert apart < 0.01 * need.tensors, "memory is a line through one and two scenes"
    shared = need.step["weights"] + need.step["moments of the optimiser, buffers"]
    saved = shared * 7 / 8 + 0.9 * buckets
    assert cost.memory(3) - cost.memory(3, 8) == pytest.approx(saved, rel=1e-6)


@pytest.mark.slow
def test_the_page_has_what_is_counted(capsys: pytest.CaptureFixture[str]) -> None:
    assert OF_MILLION in PAPER
    costs = [count(name) for name in PAPER]
    print_counts(costs)
    print_memory(costs)
    print_growth()
    rows = [row for row in capsys.readouterr().out.splitlines() if re.match(r"\| [`\d]", row)]
    assert len(rows) == 2 * len(PAPER) + 4
    assert [row for row in rows if row not in PAGE] == []
    assert set(re.findall(r"python (tools/\w+\.py)", PAGE)) == {
        "tools/count_cost.py",
        "tools/bench_store.py",
    }
