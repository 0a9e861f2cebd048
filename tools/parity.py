"""Compare qgs with golden files, whose tensors were computed by the published code.

    python tools/parity.py FILE…

For a file of a model, the model is built to fit the file's weights, with options in the metadata
that these do not determine, and called with the file's photos. For a file of losses, the loss
components are called with its tensors. All tensors of the file except inputs, weights and crops of
a data loader are compared. The exit code is 1 if a tensor differs by more than rtol 1e-4 +
atol 5e-5, or cannot be computed.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import typer
from published.files import GoldenFile, read_golden
from published.losses import loss_tensors
from published.models import golden_tensors
from published.splats import cases_tensors
from published.sweeps import sweep_tensors
from torch import Tensor

RTOL = 1e-4
ATOL = 5e-5
COMPUTED = {
    None: loss_tensors,
    "mvsplat": sweep_tensors,
    "mvsplat_cases": cases_tensors,
    "depthsplat": sweep_tensors,
    "depthsplat_cases": cases_tensors,
}
"""Functions that compute the tensors of a file, by its kind; others are of models of TokenGS."""


@dataclass(frozen=True)
class Row:
    """Comparison of a tensor: largest error relative to the tolerance, and what is wrong or "".

    An error is infinite where only one of the tensors has NaN or infinity.
    """

    name: str
    shape: tuple[int, ...] = ()
    error: float = torch.nan
    problem: str = ""


@torch.no_grad()
def compared(golden: GoldenFile) -> list[Row]:
    """Return a row for every tensor in the golden file, and for every promised tensor it lacks."""
    found = COMPUTED.get(golden.config.get("kind"), golden_tensors)(golden)
    expected = golden.expected()
    rows = [_row(name, found.get(name), tensor) for name, tensor in expected.items()]
    missing = sorted(set(golden.promised()) - set(expected))
    return rows + [Row(name, problem="listed in the metadata, not in the file") for name in missing]


def _row(name: str, found: Tensor | None, expected: Tensor) -> Row:
    shape = tuple(expected.shape)
    if found is None:
        return Row(name, shape, problem="not compared: nothing here has this name")
    if found.shape != expected.shape:
        return Row(name, shape, problem=f"shape {tuple(found.shape)} here")
    ours = found.double()
    theirs = expected.double()
    # 0 where both are the same infinity or NaN.
    same = (ours == theirs) | (ours.isnan() & theirs.isnan())
    error = (ours - theirs).abs() / (ATOL + RTOL * theirs.abs())
    error = error.nan_to_num(torch.inf, torch.inf).masked_fill(same, 0.0)
    beyond = int((error > 1).sum())
    problem = f"{beyond} of {error.numel()} beyond tolerance" if beyond else ""
    return Row(name, shape, float(error.max()), problem)


def report(path: Path) -> bool:
    """Print the comparison of one golden file; return True if all tensors agree."""
    print(path)
    try:
        rows = compared(read_golden(path))
    except Exception as error:
        # Other files are still compared.
        print(f"FAIL  {type(error).__name__}: {error}\n")
        return False
    width = max(len(row.name) for row in rows)
    print(f"{'tensor':<{width}}  {'shape':<18}  error / tolerance")
    for row in rows:
        shape = "x".join(map(str, row.shape)) or "scalar"
        verdict = f"FAIL  {row.problem}" if row.problem else "pass"
        print(f"{row.name:<{width}}  {shape:<18}  {row.error:9.2e}  {verdict}")
    failed = sum(bool(row.problem) for row in rows)
    print(f"{len(rows)} tensors, {failed} failed\n")
    return not failed


def main(files: list[Path]) -> None:
    """Compare golden FILES with published numbers, rtol 1e-4 and atol 5e-5."""
    # The order of sums, and with it their rounding, follows the number of threads.
    torch.set_num_threads(1)
    passed = [report(path) for path in files]
    print(f"{sum(passed)} of {len(passed)} files pass")
    sys.exit(not all(passed))


if __name__ == "__main__":
    typer.run(main)
