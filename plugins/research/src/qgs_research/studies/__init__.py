"""Studies for qgs: comparison of variants of a model, each trained with several seeds."""
