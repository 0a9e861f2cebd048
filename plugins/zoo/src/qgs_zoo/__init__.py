"""Published systems for qgs, one package each."""
