"""Attention with a bias that is a function; `RayBias` in numba for CPUs, Triton for GPUs.

The formula of the bias is in `qgs_locus.ray_bias`, that of attention in `attention_bias` here.
"""
