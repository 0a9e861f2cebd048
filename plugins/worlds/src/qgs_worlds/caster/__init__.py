"""The ray caster that draws rooms and worlds, and the tables that describe scenes to it."""
