"""Compare this framework with files of numbers computed by the published code.

    python tools/parity.py FILE…

A file of a model: the model is composed from the options in the file's metadata, given the file's
weights and run on its photos. A file of losses: the loss components are run on its tensors. All
tensors of the file but inputs, weights and crops of a data loader are compared. Exit status 1 if
one is beyond rtol 1e-4 + atol 5e-5, has no counterpart here, or cannot be computed.
"""

import argparse
import sys
from pathlib import Path

from published.comparison import ATOL, RTOL, Row, compare, table
from published.files import GoldenFile, GoldenFileError, read_golden
from published.losses import loss_tensors
from published.models import golden_tensors


def rows_of(path: Path) -> list[Row]:
    """A row for every tensor of the file at `path` that is no input and no weight.

    Raises ValueError for a file that cannot be computed here.
    """
    return compared(read_golden(path))


def compared(golden: GoldenFile) -> list[Row]:
    """The rows of a file that has been read; raises as `rows_of` does."""
    found = loss_tensors(golden) if golden.is_of_losses else golden_tensors(golden)
    expected = golden.expected()
    if not expected:
        raise GoldenFileError("there is nothing to compare: the file has only inputs and weights")
    return compare(found, expected, golden.promised())


def report(path: Path) -> bool:
    """Print the table of one file; whether all of it passed."""
    print(path)
    try:
        golden = read_golden(path)
        rows = compared(golden)
    except (ValueError, RuntimeError) as error:
        print(f"FAIL  {error}\n")
        return False
    failed = sum(bool(row.problem) for row in rows)
    print(*table(rows), sep="\n")
    if loader := golden.of_loader():
        print(f"not compared, of the data loader: {', '.join(loader)}")
    print(f"{len(rows)} tensors, {failed} failed\n")
    return not failed


def main() -> int:
    parser = argparse.ArgumentParser(
        description=f"Compare with published numbers, rtol {RTOL:g} and atol {ATOL:g}."
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    passed = [report(path) for path in parser.parse_args().files]
    print(f"{sum(passed)} of {len(passed)} files pass")
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
