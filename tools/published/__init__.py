"""Computation of the tensors in golden files, which were recorded with the published code.

files: reads golden files. models, splats, losses: compute their tensors by components of qgs.
"""
