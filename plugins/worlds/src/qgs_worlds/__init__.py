"""Procedural scenes for qgs with true depth: rooms and worlds, rendered by one ray caster."""
