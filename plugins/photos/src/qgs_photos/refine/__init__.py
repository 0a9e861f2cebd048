"""Per-scene refinement for qgs: predicted Gaussians, optimised on the photos of their scene."""

from qgs_photos.refine.refining import RefinedScene, refine

__all__ = ["RefinedScene", "refine"]
