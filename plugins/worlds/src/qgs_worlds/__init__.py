"""Procedural scenes for qgs with true depth: rooms and worlds, drawn by one ray caster."""
