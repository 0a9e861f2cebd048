"""Procedural scenes with exact depth maps, as data for qgs: furnished rooms, abstract worlds."""
