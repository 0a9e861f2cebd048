"""Where scenes come from, and how views are drawn from them."""

from qgs.contracts import Component
from qgs.data.rooms import RoomsSource

COMPONENTS: tuple[type[Component], ...] = (RoomsSource,)

__all__ = ["COMPONENTS", "RoomsSource"]
