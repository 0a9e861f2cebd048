"""Words that messages share."""

from collections.abc import Iterable


def listed(names: Iterable[object], most: int = 8, between: str = ", ") -> str:
    """The first `most` of `names`, and how many more there are; "" for none."""
    shown = [*map(str, names)]
    more = f" and {len(shown) - most} more" if len(shown) > most else ""
    return between.join(shown[:most]) + more


def numbered(frame: int, name: str) -> str:
    """A frame's number and its photo's name, such as "3 (images/0004.png)"; "3" without a name."""
    return f"{frame} ({name})" if name not in ("", str(frame)) else str(frame)
