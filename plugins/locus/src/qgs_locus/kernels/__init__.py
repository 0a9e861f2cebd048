"""`RayBias` compiled: numba for CPUs, Triton for GPUs. The formula is in `qgs_locus.ray_bias`."""
