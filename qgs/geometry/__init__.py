"""Functions on cameras, rays and rotations. All of them compute in float32 or float64."""
