"""Tensors to pictures and figures."""
