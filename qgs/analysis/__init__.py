"""Reconstruction of scenes, and a look inside models.

Importing it gives models what the forward pass does not need: `reconstruct` and a short `repr`.
`qgs.compose` and `qgs.load` come from here, so their models always have both.
"""

from qgs.analysis.scenes import reconstruct
from qgs.analysis.shown import model_text
from qgs.composer import compose
from qgs.io.checkpoint import load
from qgs.model import QueryGaussianModel

__all__ = ["QueryGaussianModel", "compose", "load"]

QueryGaussianModel.reconstruct = reconstruct
QueryGaussianModel.__repr__ = model_text
