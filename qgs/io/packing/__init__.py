"""Any source of scenes turned into chunks, which training reads fast."""

from qgs.io.packing.frames import Encoding
from qgs.io.packing.pack import Packed, pack
from qgs.io.packing.splits import Splits, own_splits, splits_by_list, splits_by_number

__all__ = [
    "Encoding",
    "Packed",
    "Splits",
    "own_splits",
    "pack",
    "splits_by_list",
    "splits_by_number",
]
