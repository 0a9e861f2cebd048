"""Components whose parameters are drawn, kept, saved or used wrongly."""

import torch
from contract_mutants.mutant import mutant
from torch import nn

from qgs.components import MlpFeedForward

PINNED = {
    "norm.weight": (32,),
    "norm.bias": (32,),
    "mlp.fc1.weight": (128, 32),
    "mlp.fc1.bias": (128,),
    "mlp.fc2.weight": (32, 128),
    "mlp.fc2.bias": (32,),
}
"""What saved weights of `qgs/mlp` hold in a model of width 32."""


@mutant("builds_on_meta", "scale is allocated")
class AllocatesOnCpu(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.scale = nn.Parameter(torch.ones(dims.width, device="cpu"))

    def forward(self, features):
        return self.scale * super().forward(features)


@mutant("registers_its_parameters", "keeps layers outside")
class KeepsLayersInAList(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.layers = [nn.Linear(dims.width, dims.width)]


@mutant("same_seed_same_parameters", "torch is in one state")
class SeedsWhenBuilt(MlpFeedForward):
    def __init__(self, config, dims):
        torch.manual_seed(0)
        super().__init__(config, dims)


@mutant("same_seed_same_parameters", "differ: mlp.fc1.weight")
class DrawsFromItsOwnGenerator(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        generator = torch.Generator()
        generator.seed()
        with torch.no_grad():
            self.mlp.fc1.weight.normal_(generator=generator)


@mutant("saved_weights_load", "with the same state dict, output")
class KeepsARandomBufferUnsaved(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.register_buffer("noise", torch.randn(dims.width), persistent=False)

    def forward(self, features):
        return super().forward(features) + self.noise


@mutant("state_dict_keys", "'norm.bias'", case={"state_dict": PINNED})
class RenamesItsNorm(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.layer_norm = self.norm
        del self.norm

    def forward(self, features):
        return self.mlp(self.layer_norm(features))


@mutant("moves_to_a_device", "device")
class StaysOnCpu(MlpFeedForward):
    def forward(self, features):
        return super().forward(features) * torch.ones(features.shape[-1])


@mutant("parameters_learn", "no gradient reaches unused.weight")
class HasAnUnusedLayer(MlpFeedForward):
    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.unused = nn.Linear(dims.width, dims.width)
