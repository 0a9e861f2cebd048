"""How far two tensors are apart, and whether that is small enough."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

RTOL = 1e-4
ATOL = 5e-5


@dataclass(frozen=True)
class Row:
    """One tensor: its largest absolute and relative error, and what is wrong with it, if anything.

    Errors are infinite where one has NaN or infinity and the other has not; None where nothing was
    compared. Relative errors leave out elements that are expected to be 0.
    """

    name: str
    shape: tuple[int, ...] = ()
    absolute: float | None = None
    relative: float | None = None
    problem: str = ""


def compare(
    found: Mapping[str, Tensor], expected: Mapping[str, Tensor], promised: list[str]
) -> list[Row]:
    """A row for every expected tensor, and one for every promised name that the file lacks."""
    rows = [_row(name, found.get(name), tensor) for name, tensor in expected.items()]
    missing = sorted(set(promised) - set(expected))
    return rows + [
        Row(name, problem="listed in the metadata, missing in the file") for name in missing
    ]


def _row(name: str, found: Tensor | None, expected: Tensor) -> Row:
    shape = tuple(expected.shape)
    if found is None:
        return Row(name, shape, problem="not compared: nothing here has this name")
    if found.shape != expected.shape:
        return Row(name, shape, problem=f"shape {tuple(found.shape)} here")
    ours = found.detach().double()
    theirs = expected.double()
    # 0 where both are the same infinity or NaN, infinite where one alone is.
    same = (ours == theirs) | (ours.isnan() & theirs.isnan())
    error = (ours - theirs).abs().nan_to_num(torch.inf, torch.inf).masked_fill(same, 0.0)
    relative = (error / theirs.abs()).nan_to_num(torch.inf)[(theirs != 0) & (error > 0)]
    absolute, relative = (float(x.max()) if x.numel() else 0.0 for x in (error, relative))
    close = torch.isclose(ours, theirs, rtol=RTOL, atol=ATOL, equal_nan=True)
    beyond = int((~close).sum())
    problem = f"{beyond} of {close.numel()} beyond tolerance" if beyond else ""
    return Row(name, shape, absolute, relative, problem)


def table(rows: list[Row]) -> Iterator[str]:
    """The rows as lines of text, failures marked."""
    width = max((len(row.name) for row in rows), default=0)
    yield f"{'tensor':<{width}}  {'shape':<18}  {'max abs':>9}  {'max rel':>9}"
    for row in rows:
        shape = "x".join(map(str, row.shape)) or "scalar"
        verdict = f"FAIL  {row.problem}" if row.problem else "pass"
        errors = f"{_number(row.absolute):>9}  {_number(row.relative):>9}"
        yield f"{row.name:<{width}}  {shape:<18}  {errors}  {verdict}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2e}"
