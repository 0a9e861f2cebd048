"""Refinement: optimise the Gaussians of one scene on its photos."""

from qgs_photos.refine.refining import RefinedScene, refine

__all__ = ["RefinedScene", "refine"]
