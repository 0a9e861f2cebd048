"""Plugins whose components depend on each other."""

import pytest

SPATIAL = """
from typing import Literal
from qgs.contracts import (
    CrossAttention, ComponentConfig, FieldSpec, LearnedQueries, Plugin, Refinement, SceneSource)

PLACE = {"place.center": FieldSpec((3,), frame="world")}
RADIUS = {"place.radius": FieldSpec((1,), frame="world")}

class Placed(LearnedQueries):
    name = "placed"
    class Config(ComponentConfig):
        count: int = 4
        radius: bool = True
    @classmethod
    def fields_written(cls, config):
        return PLACE | (RADIUS if config.radius else {})
    @property
    def count(self):
        return self.config.count
    def start(self, batch_size):
        raise NotImplementedError

class Near(CrossAttention):
    name = "near"
    class Config(ComponentConfig):
        bandwidth: Literal["radius", "fixed"] = "radius"
        sigma: float = 0.1
    @classmethod
    def fields_read(cls, config):
        return PLACE | (RADIUS if config.bandwidth == "radius" else {})
    def forward(self, state, memory):
        raise NotImplementedError

class Measure(Refinement):
    name = "measure"
    @classmethod
    def fields_written(cls, config):
        return RADIUS
    def forward(self, state):
        return state

class Local(Refinement):
    name = "local"
    @classmethod
    def fields_read(cls, config):
        return {"place.center": FieldSpec((3,), frame="camera")}
    def forward(self, state):
        return state

class Scenes(SceneSource):
    name = "scenes"
    def scenes(self, split):
        return []

plugin = Plugin("spatial", 1, (Placed, Near, Measure, Local, Scenes))
"""
MINE = """
from qgs.tokengs import MultiViewViT
from qgs.contracts import MEMORY_FIELDS, DecoderLayer, FieldSpec, Loss, Plugin, Queries, Refinement
from qgs.contracts.head import GAUSSIAN_FIELDS

PLACE = {"place": FieldSpec((3,))}

class Start(Queries):
    name = "start"
    reads = {"memory.grid": MEMORY_FIELDS["memory.grid"]}
    writes = PLACE

class Keep(Refinement):
    name = "keep"
    reads = writes = PLACE

class Late(Refinement):
    name = "late"
    writes = PLACE

class Joint(DecoderLayer):
    name = "joint"
    reads_layer_scale = False
    reads = {"memory.features": MEMORY_FIELDS["memory.features"]}

class Placed(Joint):
    name = "placed"
    reads = PLACE

class Blind(MultiViewViT):
    name = "blind"
    writes = {"memory.features": FieldSpec((32,))}

class FeatureLoss(Loss):
    name = "features"
    reads = {"gaussians.features": GAUSSIAN_FIELDS["gaussians.features"]}

class Apart(Refinement):
    name = "apart"
    shared_by_layers = False
    def forward(self, state):
        return state

plugin = Plugin("mine", 1, (Start, Keep, Late, Joint, Placed, Blind, FeatureLoss, Apart))
"""
SECOND = """
from qgs.tokengs import LatentQueries
from qgs.contracts import Plugin
plugin = Plugin("second", 1, (LatentQueries,))
"""


@pytest.fixture
def installed(install):
    """Sound plugins: `spatial` and `mine`, whose components depend on each other, and `second`."""
    for name, source in (("spatial", SPATIAL), ("mine", MINE), ("second", SECOND)):
        install(f"qgs-{name}", name, source)
