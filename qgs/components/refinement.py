"""`qgs/none`: nothing to refine (TokenGS)."""

from __future__ import annotations

from typing import ClassVar

from qgs.contracts import Refinement
from qgs.types import QueryState


class NoRefinement(Refinement):
    """Passes the state on."""

    name: ClassVar[str] = "none"

    def forward(self, state: QueryState) -> QueryState:
        """The state, as it is."""
        return state
