"""Tables of what must be refused: what is not, or for another reason, is told."""

import re


def fault(match, function, *given, kind=ValueError):
    """What is wrong unless `function` raises `kind` with `match`; an empty text if nothing is."""
    try:
        function(*given)
    except kind as error:
        return "" if re.search(match, str(error)) else f"{match} is not in: {error}"
    return f"{match}: nothing is raised"


def must_refuse(match, function, *given, kind=ValueError):
    """`function` raises `kind` with `match`."""
    found = fault(match, function, *given, kind=kind)
    assert not found, found
