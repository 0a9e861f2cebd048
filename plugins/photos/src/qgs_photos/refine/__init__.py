"""Per-scene refinement for qgs: predicted Gaussians, optimised on the photos of their scene."""

from qgs_photos.refine.refining import CurvePoint, RefinedScene, refine

__all__ = ["CurvePoint", "RefinedScene", "refine"]
