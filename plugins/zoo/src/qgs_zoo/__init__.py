"""Published systems for qgs, with one package for each."""
