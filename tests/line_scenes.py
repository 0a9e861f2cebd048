"""Scenes made of numbers, and a source of them, for tests of data."""

import numpy as np
import torch
from walk import along_x, pinhole

from qgs.contracts import SceneSource, SceneSourceConfig
from qgs.data.view_samplers import Span
from qgs.evaluate.plan import EvaluationPlan
from qgs.reconstruction.scenes import GivenScene
from qgs.types import Views

DOWN = torch.tensor([0.0, 1, 0])
SPAN = Span(Span.Config())


def drawn(scene, views, seed, step=0, sampler=SPAN):
    """Inputs and targets as they are drawn for a training."""
    return sampler.draw(scene, views, np.random.default_rng(seed), step)


def values(frames):
    """What images (F, 3, H, W) of a `Line` are about."""
    return torch.tensor(list(frames)).view(-1, 1, 1, 1) / 100


class Line(GivenScene):
    """Cameras along a line; frame f is an image of the value f / 100, brighter to the right.

    c2w: other poses. more: masks or times of the frames (1, F).
    """

    def __init__(self, count, held_out=(), step=0.5, name="", c2w=None, **more):
        c2w = along_x(step * torch.arange(count) + 3) if c2w is None else c2w
        images = values(range(count)) + torch.arange(8) / 1000 + torch.zeros(3, 8, 1)
        super().__init__(Views(images[None], pinhole(c2w, (8.0, 8, 3, 4), (8, 8))[None], **more))
        self.name = name or f"line{count}"
        self.held_out = held_out


class Lines(SceneSource):
    name = "lines"

    def __init__(self, *scenes):
        super().__init__(SceneSourceConfig(image_size=(8, 8)))
        self._scenes = scenes

    def scenes(self, split):
        return self._scenes


def plan_of(source, views, evaluation, sampler=SPAN, **options):
    """A plan, by default with the default sampler."""
    return EvaluationPlan(source, views, evaluation, sampler, **options)


def samples_of(*given, **options):
    """All samples of a plan; a scene that fails raises."""
    plan = plan_of(*given, **options)
    return [sample for scene in plan.wanted for sample in plan.samples(scene)]


def judged_samples(recipe, **options):
    """Those that an evaluation of a recipe scores."""
    sampler = recipe.build_view_sampler()
    return samples_of(recipe.build_data(), recipe.views, recipe.evaluation, sampler, **options)
