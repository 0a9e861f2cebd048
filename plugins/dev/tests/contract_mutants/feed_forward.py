"""MLPs that break the contract in one expression of their forward pass."""

import random

import torch
from contract_mutants.mutant import mutant

from qgs.tokengs import MlpFeedForward

sound = MlpFeedForward.forward


def register(name, check, seen, forward):
    """forward: of the component and features (B, N, D)."""
    mutant(check, seen)(type(name, (MlpFeedForward,), {"forward": forward}))


register("ForgetsToReturn", "runs", "component returns NoneType, not Tensor", lambda self, x: None)
register(
    "DetachesASummand", "gradients_match_differences", "in evaluation: Jacobian",
    lambda self, x: sound(self, x) + x.square().detach()
)  # fmt: skip
register(  # the same numbers in both modes
    "DetachesASummandInTraining", "gradients_match_differences", "in training: Jacobian",
    lambda self, x: sound(self, x) + self.training * (x.square().detach() - x.square())
)  # fmt: skip
register(
    "DividesByLength", "zeros_stay_finite", "output: not finite in evaluation, with zeros",
    lambda self, x: sound(self, x / x.norm(dim=-1, keepdim=True))
)  # fmt: skip
register(
    "Exponentiates", "large_numbers_stay_finite", "in evaluation, with inputs times 1e4",
    lambda self, x: sound(self, x.exp())
)  # fmt: skip
register(
    "CentresOnTheBatch", "batch_independence", "scene 0 has a gradient",
    lambda self, x: sound(self, x - x.mean(0, keepdim=True))
)  # fmt: skip
register(
    "ReturnsItsInput", "outputs_share_no_memory", "shares memory with `features`",
    lambda self, x: x.view_as(x)
)  # fmt: skip
register(
    "AddsNoise", "eval_repeats_bitwise", "a second pass on the same inputs differs, output",
    lambda self, x: sound(self, x) + 0.01 * torch.randn_like(x)
)  # fmt: skip
register(
    "DropsByPythonsRandom", "training_draws_from_torch", "numpy's or random's",
    lambda self, x: sound(self, x) * (random.random() if self.training else 1)
)  # fmt: skip
register(
    "StaysOnCpu", "construction", "device",
    lambda self, x: sound(self, x) * torch.ones(x.shape[-1])
)  # fmt: skip
register(
    "CancelsDigits", "autocast_is_close", "`output` is off by",
    lambda self, x: sound(self, (x + 300) - 300)
)  # fmt: skip
register(
    "GivesFloat32", "float64_stays_float64", "`output` is 2x6x32 float32",
    lambda self, x: sound(self, x).float()
)  # fmt: skip
register(
    "LoopsOverQueries", "compiles", "3 new graphs are compiled",
    lambda self, x: torch.stack([self.mlp(self.norm(each)) for each in x.unbind(1)], 1)
)  # fmt: skip
register(
    "DetachesWhenCompiled", "compiles", "features: has a gradient only",
    lambda self, x: sound(self, x.detach() if torch.compiler.is_compiling() else x)
)  # fmt: skip
