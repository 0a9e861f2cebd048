"""What tests demand in one line: a refusal, the same bits."""

from functools import partial

import pytest
from torch.testing import assert_close

assert_equal = partial(assert_close, rtol=0, atol=0)


def must_refuse(match, function, *given, kind=ValueError, **options):
    """`function` raises `kind` with `match`."""
    with pytest.raises(kind, match=match):
        function(*given, **options)
