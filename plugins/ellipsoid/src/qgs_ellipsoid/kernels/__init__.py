"""`EllipsoidBias` compiled, for CPUs and GPUs. The formula is in `qgs_ellipsoid.ray_bias`."""
