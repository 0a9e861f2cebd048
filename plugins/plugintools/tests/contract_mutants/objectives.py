"""Objectives that break their contract."""

from dataclasses import replace

import torch
from contract_mutants.mutant import mutant
from torch import nn

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


@mutant("objective_gives_an_outcome", "its signs are ['alpha', 'psnr']")
class LosesASign(Changed):
    def result(self, outcome):
        kept = {name: x for name, x in outcome.signs.items() if name != "deviation"}
        return replace(outcome, signs=kept)


@mutant("objective_gives_an_outcome", "it judges no prediction")
class JudgesNothing(OnePass):
    def forward(self, inputs, targets, passes):
        alpha = passes.predict(inputs).gaussians.opacities.mean()
        signs = dict.fromkeys(("psnr", "alpha", "deviation"), alpha.detach())
        return Outcome(alpha, {"faint": alpha.detach()}, signs)


@mutant("objective_gives_an_outcome", "it predicts from no view")
class LeavesOutTwoViews(OnePass):
    def forward(self, inputs, targets, passes):
        return super().forward(inputs.select(slice(2, None)), targets, passes)


@mutant("objective_gives_an_outcome", "it is an nn.Module")
class HasParameters(OnePass, nn.Module):
    def __init__(self, config):
        nn.Module.__init__(self)
        self.config, self.scale = config, nn.Parameter(torch.ones(()))


@mutant("objective_repeats", "the second time")
class CountsItsJudgements(Changed):
    calls = 0

    def result(self, outcome):
        self.calls += 1
        factor = 1 + 1 / self.calls
        terms = {name: factor * x for name, x in outcome.terms.items()}
        return replace(outcome, total=factor * outcome.total, terms=terms)


@mutant("scheduled_options_are_read_anew", "with `weight: 0.5` set after it was built")
class ReadsItsWeightOnceForAll(OnePass):
    scheduled = frozenset({"weight"})

    class Config(OnePass.Config):
        weight: float = 1.0

    def __init__(self, config):
        super().__init__(config)
        self.weight = config.weight

    def forward(self, inputs, targets, passes):
        outcome = super().forward(inputs, targets, passes)
        terms = {name: self.weight * x for name, x in outcome.terms.items()}
        return replace(outcome, total=self.weight * outcome.total, terms=terms)
