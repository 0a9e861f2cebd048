"""A small model of each kind, and what it makes of the walk."""

from copy import deepcopy
from functools import cache

import yaml
from commands import ONE_LAYER
from qgs_dev.case import seeded
from qgs_viewer.opening import ModelSource
from qgs_viewer.scenes import scenes_of
from small_parts import shaken
from walk import Walk

import qgs
from qgs.contracts import ViewsConfig
from qgs.data.samples import make_sample
from qgs.domain import KEY, Domain
from qgs.recipe import resolve

QUERIES = 12
VIEWS = ViewsConfig(inputs=2, gap=(1, 5), scale="auto")
BY_DISTANCE = VIEWS.model_copy(update={"scale": "distance", "scale_factor": 0.7})
KINDS = ("tokengs", "locus", "ellipsoid")
PAIR = KINDS[:2]
REST = """
plugins: [rooms]
data: {type: rooms/procedural, image_size: [16, 16], test_scenes: 3}
views: {inputs: 2, targets: 2, gap: [2, 4], scale_factor: 0.4}
evaluation: {scenes: 2}
"""
RECIPE = ONE_LAYER | yaml.safe_load(REST)
"""Of a model that takes no time, with rooms of its own."""


def stand_in(file, queries=8):
    """Write an untrained model of RECIPE that knows on what views it was trained; its name."""
    ranges = yaml.safe_load("{baseline: [0.1, 0.3], turn: [2.0, 20.0], depth: [1.0, 2.0]}")
    model = resolve(RECIPE, [f"model.queries.count={queries}"]).build_model()
    qgs.save(model, file, extra={KEY: Domain(ranges, 48).text, "step": "7000"})
    return str(file)


@cache
def model_of(kind, *overrides):
    """Untrained, with QUERIES queries."""
    settings = [f"model.queries.count={QUERIES}", *overrides]
    with seeded(0):
        return resolve(f"tiny/{kind}.yaml", settings).build_model().eval()


def sample_of(inputs=(1, 4), targets=(2, 3)):
    """The walk as a model sees it."""
    return make_sample(Walk(), inputs, targets, VIEWS)


@cache
def model_scenes_of(kind):
    """The walk by the small model, with refinements that move anchors, as trained ones do."""
    model = deepcopy(model_of(kind))
    with seeded(2):
        shaken(model.refinements, 0.03).float()
    return scenes_of(kind, model, [sample_of(), sample_of((0, 5))])


def source_of(kind, views=VIEWS):
    return ModelSource(model_scenes_of(kind).network, Walk(), views, (1, 4), f"{kind}: walk")
