"""Attention with a computed bias: `RayBias` in numba for CPUs, in Triton for GPUs.

`qgs_locus.ray_bias` has the formula of the bias; `attention_bias` has that of attention.
"""
