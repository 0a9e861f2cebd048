"""Reconstruction of scenes, and a look inside models.

Importing it gives models what the forward pass does not need: `reconstruct` and a short `repr`.
`qgs.compose`, `qgs.load` and `qgs.QueryGaussianModel` come from here, so models have both.
"""

from qgs.analysis.scenes import reconstruct
from qgs.analysis.shown import model_text
from qgs.composer import compose
from qgs.io.checkpoint import load
from qgs.model import QueryGaussianModel

__all__ = ["QueryGaussianModel", "compose", "load"]

# Set from here, not defined in the class: `reconstruct` opens photos and resolves recipes, which
# needs `qgs.composer` and `qgs.io`, both layers above `qgs.model`. A method with a local import
# would be an upward import as well. The class declares the method, so that type checkers see it.
QueryGaussianModel.reconstruct = reconstruct
QueryGaussianModel.__repr__ = model_text
