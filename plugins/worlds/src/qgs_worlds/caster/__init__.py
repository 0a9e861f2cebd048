"""Ray caster for procedural rooms and worlds, and the tables that describe scenes to it."""
