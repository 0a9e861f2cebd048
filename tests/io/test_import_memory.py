"""The memory that importing a file of a gigabyte takes."""

from pathlib import Path

import pytest
from measure_import import LIMIT, PUBLISHED, peak_of_import

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["safetensors", "torch"])
def test_a_published_file_is_imported_without_copies(tmp_path: Path, kind: str) -> None:
    size, peak = peak_of_import(str(ROOT / PUBLISHED), kind, tmp_path)
    assert size > 0.9e9
    assert peak < LIMIT * size
