"""An objective and its optimiser, made ready for one process or many."""

from __future__ import annotations

from accelerate import Accelerator
from torch import nn
from torch.optim import Optimizer

from qgs.contracts import TrainingConfig
from qgs.engine.objective import Objective
from qgs.engine.optimizer import make_optimizer
from qgs.engine.processes import shard, wants_shards


def prepared(
    accelerator: Accelerator, objective: Objective, config: TrainingConfig
) -> tuple[nn.Module, Optimizer]:
    """`objective`, wrapped where processes must exchange gradients, and its optimiser.

    Under `accelerate launch --use_fsdp` the model's parameters are laid in shards, in place and
    before the optimiser is made, so that its moments lie in shards too; else several processes run
    DistributedDataParallel.
    """
    if wants_shards(accelerator):
        shard(objective.model)
        return objective, make_optimizer(objective, config)
    return accelerator.prepare(objective, make_optimizer(objective, config))
