"""`EllipsoidBias` compiled, for CPUs and GPUs; the formula is in its module."""
