"""`EllipsoidBias` compiled, for CPUs and GPUs. The formula is in `qgs_anchors.ellipsoid.ray_bias`."""
