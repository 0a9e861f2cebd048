"""Ray caster for rooms and worlds, and the tables that describe scenes to it."""
