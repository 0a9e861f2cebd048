"""Whether a model learns: one batch by heart."""

import torch
from training_runs import first_batch

from qgs.engine.training_pass import TrainingPass


def errors_of_training(recipe, steps, rate):
    """What the objective says of the same batch in each step."""
    judged = TrainingPass.of(recipe, recipe.build_model().train())
    batch = first_batch(recipe)
    optimizer = torch.optim.AdamW(judged.parameters(), rate)
    errors = []
    for _ in range(steps):
        total = judged(batch.inputs, batch.targets).total
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        errors.append(total.item())
    return errors
