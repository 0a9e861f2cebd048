"""Reconstruct the scenes that report pages and figures show."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from qgs.data.samples import Sample
from qgs.evaluate.plan import EvaluationPlan
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Gaussians
from qgs.wording import listed, one_line
from qgs_viewer.comparison import Model
from qgs_viewer.curves import Curves, curves_of
from qgs_viewer.queries import DrawnQuery, colored_queries, notable_queries
from qgs_viewer.query_scene import QueryScene, explained


@dataclass(frozen=True)
class ModelScenes:
    """A model and its reconstructions of several samples.

    samples: input and target views in the world of this model. gaussians: the reconstruction of
    each sample. scene: the reconstruction of the first sample, with its queries. curves: loss and
    PSNR of the training; empty if no history is stored.
    """

    name: str
    network: QueryGaussianModel
    samples: Sequence[Sample]
    gaussians: Sequence[Gaussians]
    scene: QueryScene
    curves: Curves = ()

    @property
    def target_camera(self) -> Cameras:
        """The camera (1, 1) of the first target view in the first sample."""
        return self.samples[0].targets.cameras[:, :1]

    def notable(self, count: int, cameras: Cameras, query: int | None) -> list[DrawnQuery]:
        """Return the query with the index `query`; if it is None, `count` well visible queries.

        cameras: (1, V); only the first camera is used (see `notable_queries`).
        """
        if query is None:
            return notable_queries(self.network, self.gaussians[0], cameras, count)
        return colored_queries(self.gaussians[0], self.scene.queries, [query])


@torch.no_grad()
def model_scenes(
    models: Sequence[Model], most: int | None = None, scene: str | None = None
) -> list[ModelScenes]:
    """Reconstruct the scenes of the evaluation by each model, on the device of the model.

    most: number of scenes to reconstruct, from one sample of views each; None takes all samples of
    the evaluation. scene: name of the scene to put first. Raises ValueError if this scene is not
    evaluated.
    """
    first = models[0].recipe
    # Scenes are drawn, whatever index the scores are of.
    evaluation = first.evaluation.model_copy(update={"index": None})
    if most is not None:
        evaluation = evaluation.model_copy(update={"scenes": most, "samples": 1})
    source = first.build_data()
    samples: list[Sample] = []
    shown = []
    for model in models:
        views = model.recipe.views
        # models in worlds of one unit share the samples: photos take long to decode
        if not samples or views.scale == "search" or views != first.views:
            plan = EvaluationPlan(
                source,
                views,
                evaluation,
                model.windows or model.recipe.build_view_sampler(),
                model.views_of,
                # true depths cost as much as photos to decode, and one copy is enough
                depths=not shown,
            )
            samples = _samples(plan)[:most]
            names = dict.fromkeys(sample.scene for sample in samples)
            if scene is not None and scene not in names:
                raise ValueError(
                    f"--scene {scene!r} is not one of the evaluated scenes: choose from "
                    f"{listed(names)}"
                )
            # sorting is stable: the others keep their order
            samples.sort(key=lambda sample: sample.scene != scene)
        found = scenes_of(model.name, model.network, samples)
        shown.append(replace(found, curves=curves_of(model.file)))
    return shown


def _samples(plan: EvaluationPlan) -> list[Sample]:
    """Return the samples of all scenes. Raises ValueError if a scene cannot be read."""
    samples: list[Sample] = []
    for scene in plan.wanted:
        try:
            samples += plan.samples(scene)
        except Exception as error:  # whatever a reader raises
            raise ValueError(f"scene {scene!r} cannot be evaluated: {one_line(error)}") from error
    return samples


@torch.no_grad()
def scenes_of(name: str, network: QueryGaussianModel, samples: Sequence[Sample]) -> ModelScenes:
    """Reconstruct `samples` by `network`, and keep the queries of the first sample."""
    # components draw random numbers in training mode
    network.eval()
    device = network.device
    own = [
        replace(sample, inputs=sample.inputs.to(device), targets=sample.targets.to(device))
        for sample in samples
    ]
    scene = explained(network, own[0].inputs, own[0].input_frames)
    others = [network(sample.inputs).gaussians for sample in own[1:]]
    return ModelScenes(name, network, own, [scene.gaussians, *others], scene)
