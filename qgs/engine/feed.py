"""The batches of one optimiser step after another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice

from qgs.data.sampling import Batch


class Feed:
    """Holds the batches of the step that comes next.

    They are fetched while the step before is not over, so that processes can agree on a failure
    where they exchange numbers anyway: one that ended alone would leave the others waiting.

    error: what fetching raised; after that there are no batches any more.
    """

    def __init__(self, stream: Iterator[Batch], count: int) -> None:
        self.batches: Sequence[Batch] = ()
        self.error: Exception | None = None
        self._stream = stream
        self._count = count

    def fetch(self) -> None:
        """Get the `count` batches of the next step, or the error."""
        try:
            self.batches = list(islice(self._stream, self._count))
        except Exception as error:  # raised by whoever reads `error`
            self.batches, self.error = (), error
