"""Lines of tables of what must be refused."""

import pytest


def must_refuse(match, function, *given, kind=ValueError, **options):
    """`function` raises `kind` with `match`."""
    with pytest.raises(kind, match=match):
        function(*given, **options)
