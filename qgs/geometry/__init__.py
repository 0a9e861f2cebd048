"""Functions on cameras, rays and rotations. All compute in float32 or float64."""
