"""Studies for qgs: variants of a model, each trained with several seeds, in one table."""
