"""Words that messages share."""

from collections.abc import Iterable


def listed(names: Iterable[object], most: int = 8, between: str = ", ") -> str:
    """The first `most` of `names`, and how many more there are; "" for none.

    Long ones are cut, those that no terminal prints as they are escaped.
    """
    shown = [*map(str, names)]
    more = f" and {len(shown) - most} more" if len(shown) > most else ""
    return between.join(name_shown(name) for name in shown[:most]) + more


def name_shown(name: str, most: int = 500) -> str:
    """`name` as a message shows it, of at most some characters."""
    name = name if name.replace("\n", "").isprintable() else repr(name)
    return name if len(name) <= most else f"{name[:most]} ... ({len(name):,} characters)"
