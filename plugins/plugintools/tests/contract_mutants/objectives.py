"""Objectives that break their contract."""

from dataclasses import replace

from contract_mutants.mutant import mutant

from qgs.components import OnePass
from qgs.contracts import Outcome


class Changed(OnePass):
    """A sound objective, whose outcome mutants change."""

    def result(self, outcome: Outcome) -> Outcome:
        return outcome

    def forward(self, inputs, targets, passes):
        return self.result(super().forward(inputs, targets, passes))


@mutant("objective_gives_an_outcome", "has no gradient in the model's parameters")
class DetachesTheTotal(Changed):
    def result(self, outcome):
        return replace(outcome, total=outcome.total.detach())


@mutant("objective_gives_an_outcome", "against the sum of the terms")
class HidesATerm(Changed):
    def result(self, outcome):
        return replace(outcome, total=2 * outcome.total)


@mutant("objective_repeats", "the second time")
class CountsItsJudgements(Changed):
    calls = 0

    def result(self, outcome):
        self.calls += 1
        factor = 1 + 1 / self.calls
        terms = {name: factor * x for name, x in outcome.terms.items()}
        return replace(outcome, total=factor * outcome.total, terms=terms)
