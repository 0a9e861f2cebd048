"""How kernels are compiled."""

from qgs_rooms.textures import INNER

BORROWING = {**INNER, "_nrt": False}
"""For functions that allocate no arrays: they count no references to those that they are given,
which would take longer than what is done with them."""
