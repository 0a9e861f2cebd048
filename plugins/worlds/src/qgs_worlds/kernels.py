"""How kernels are compiled."""

from typing import Any

from qgs_worlds.rooms.textures import INNER

BORROWING: dict[str, Any] = {**INNER, "_nrt": False}
"""For functions that allocate no arrays: they count no references to those that they are given,
which would take longer than what is done with them."""

REDUCING: dict[str, Any] = {**BORROWING, "fastmath": {"contract", "reassoc", "arcp", "nsz", "nnan"}}
"""For least values over a loop, which LLVM vectorises if no number is NaN."""
