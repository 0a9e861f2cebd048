"""Procedural scenes for qgs with exact depth maps: furnished rooms and abstract worlds."""
