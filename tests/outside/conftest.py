"""One fresh environment for all tests that need one: making it takes most of the time."""

import pytest
from fresh_environment import make_fresh_environment


@pytest.fixture(scope="session")
def fresh(tmp_path_factory):
    """qgs, LocusGS, worlds and tools for authors from wheels, nothing from the source tree."""
    return make_fresh_environment(tmp_path_factory.mktemp("fresh"))
