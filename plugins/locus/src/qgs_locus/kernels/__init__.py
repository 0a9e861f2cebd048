"""Fast attention with the bias `RayBias`: numba kernels for CPUs, Triton kernels for GPUs.

The formula of the bias is in `qgs_locus.ray_bias`, the formula of attention in `attention_bias`.
"""
