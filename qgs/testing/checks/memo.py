"""What `ImageMemory.once` keeps for all decoder layers is the same for all of them."""

from __future__ import annotations

from dataclasses import replace

from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import check
from qgs.testing.subjects import inputs_of
from qgs.testing.trees import difference


@check({"cross_attention"})
def check_memo_is_of_the_memory_alone(case: Case) -> None:
    """What `ImageMemory.once` keeps is made of the memory: not of the state, nor of a weight.

    A layer gives on a memory that others have read what it gives on a fresh one. What a layer's own
    weights make of the memory belongs to that layer alone, and into no memo.
    """
    layer, next_layer = case.lively(seed=0), case.lively(seed=1)
    inputs, later = inputs_of(case), inputs_of(case, seed=1)
    memory = inputs["memory"]
    layer(inputs["state"], memory)
    for reader, what in ((layer, "the state"), (next_layer, "a weight")):
        read = reader(later["state"], memory)
        found = difference(reader(later["state"], replace(memory)), read)
        seen = f"what it keeps in the memory depends on {what}: read after another layer, {found}"
        expect(not found, seen)
