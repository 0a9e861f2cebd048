"""Reconstruction of scenes, and a look inside models.

Importing it gives models what the forward pass does not need: `reconstruct` and a short `repr`.
`qgs.compose`, `qgs.load` and `qgs.QueryGaussianModel` come from here, so models have both.
"""

from qgs.checkpoint.model_file import load
from qgs.model import QueryGaussianModel
from qgs.recipe import compose
from qgs.reconstruction.scenes import reconstruct
from qgs.reconstruction.shown import model_text

__all__ = ["QueryGaussianModel", "compose", "load"]

# Set from here, not defined in the class: `reconstruct` opens photos and resolves recipes, which
# needs `qgs.recipe` and `qgs.checkpoint`, both layers above `qgs.model`. A method with a local import
# would be an upward import as well. The class declares the method, so that type checkers see it.
QueryGaussianModel.reconstruct = reconstruct
QueryGaussianModel.__repr__ = model_text
