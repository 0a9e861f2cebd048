"""Where the world's origin lies, and where its axes point, means nothing to images and losses."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from qgs.geometry.transforms import quat_to_matrix
from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import check
from qgs.testing.subjects import Inputs, inputs_of, is_place, required_fields
from qgs.testing.trees import distance, mapped

TURN = (0.8, 0.4, -0.2, 0.4)
"""A unit quaternion, w x y z, about no axis of the world."""
SHIFT = (0.4, -0.3, 0.6)


@check({"renderer"})
def check_rendering_is_invariant(case: Case) -> None:
    """Moving the world, Gaussians and cameras alike, leaves every image as it is."""
    module, inputs = case.lively(), inputs_of(case)
    found = distance(
        module(*inputs.values()), module(*moved_world(case, inputs).values()), 1e-2, 2e-3
    )
    expect(not found, f"in a moved world, {found}")


@check({"losses"})
def check_loss_is_invariant(case: Case) -> None:
    """Moving the world, Gaussians, fields and cameras alike, leaves every loss as it is."""
    module, inputs = case.lively(), inputs_of(case)
    found = distance(
        module(*inputs.values()), module(*moved_world(case, inputs).values()), 1e-3, 1e-5
    )
    expect(not found, f"in a moved world, {found}")


def moved_world(case: Case, inputs: Inputs) -> Inputs:
    """The same scene, in another frame of the world."""
    turn, shift = quat_to_matrix(torch.tensor(TURN)), torch.tensor(SHIFT)
    places = {name for name, spec in required_fields(case).items() if is_place(spec)}

    def visit(name: str, x: Tensor) -> Any:
        turned, shifted = turn.to(x), shift.to(x)
        if name.endswith("gaussians.means") or name.partition("fields.")[2] in places:
            return x @ turned.T + shifted
        if name.endswith("quats"):
            return _turned_quats(x)
        if name.endswith("c2w"):
            rotation = turned @ x[..., :3, :3]
            position = x[..., :3, 3:].transpose(-1, -2) @ turned.T + shifted
            top = torch.cat([rotation, position.transpose(-1, -2)], -1)
            return torch.cat([top, x[..., 3:, :]], -2)
        return x

    return mapped(inputs, visit)


def _turned_quats(quats: Tensor) -> Tensor:
    """Rotations (..., 4), w x y z, followed by TURN: Hamilton's product."""
    a, b, c, d = TURN
    w, x, y, z = quats.unbind(-1)
    product = (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
    return torch.stack(product, -1)
