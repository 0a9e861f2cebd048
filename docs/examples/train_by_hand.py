"""Train a model by a loop of your own, and save a scene that it reconstructs.

    python docs/examples/train_by_hand.py recipes/tiny/locus.yaml 200 scene.ply

The recipe gives the model, the data with its sampler of views, and the losses; the loop is plain
PyTorch, to copy and change. It ignores the recipe's optimiser, its schedules and its section
`training`: rate, batch size and clipping stand below. `qgs train` follows them, and adds resuming,
several processes, mixed precision, evaluation, and a watch for steps that are not finite.
"""

import sys
from itertools import islice
from pathlib import Path

import torch
from torch import Tensor

import qgs
from qgs.contracts import Loss
from qgs.data.samples import Batch
from qgs.data.stream import SampleStream, training_batches
from qgs.recipe import Recipe, resolve


def loss_of(model: qgs.QueryGaussianModel, losses: dict[str, Loss], batch: Batch) -> Tensor:
    """Sum the recipe's losses over the supervised layers, with their weights."""
    # In training mode the model decodes Gaussians after every supervised layer, not the last only.
    prediction = model(batch.inputs)
    total = torch.zeros(())
    for number, weight in model.supervision.weights().items():
        layer = prediction.layers[number]
        rendering = model.render(layer.gaussians, batch.targets.cameras)
        for loss in losses.values():
            terms = loss(layer, rendering, batch.targets, batch.inputs)
            total = total + weight * sum(terms.values())  # none at a weight of 0
    return total


def train(recipe: Recipe, steps: int) -> qgs.QueryGaussianModel:
    """Train for `steps` of AdamW at a constant rate after a short warm-up."""
    torch.manual_seed(recipe.seed)
    model = recipe.build_model().train()
    losses = recipe.build_losses()
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3, betas=(0.9, 0.95))
    warmup = torch.optim.lr_scheduler.LinearLR(optimizer, 0.01, total_iters=20)
    # Batches are endless; batch k depends on the seed and k alone.
    samples = SampleStream(
        recipe.build_data(),
        recipe.views,
        recipe.seed,
        sampler=recipe.build_view_sampler(),
        depths=any(loss.reads_depths for loss in losses.values()),
    )
    batches = training_batches(samples, batch_size=2)
    for step, batch in enumerate(islice(batches, steps)):
        loss = loss_of(model, losses, batch)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        warmup.step()
        if step % 10 == 0:
            print(f"step {step:5}  loss {loss.item():.4f}", flush=True)
    batches.close()
    return model.eval()


def main() -> None:
    """Train, reconstruct the first test scene, write its Gaussians and the model's checkpoint."""
    name, steps, out = sys.argv[1:]
    recipe = resolve(name)
    model = train(recipe, int(steps))
    scene = recipe.build_data().scenes("test")[0]
    frames = list(range(recipe.views.inputs))
    photos = qgs.Views(scene.images(frames)[None], scene.cameras[frames][None])
    result = qgs.reconstruct(model, photos)  # normalises the poses as in training
    qgs.save_ply(result.in_photos_world, out)
    qgs.save(model, Path(out).with_suffix(".safetensors"))


if __name__ == "__main__":
    main()
