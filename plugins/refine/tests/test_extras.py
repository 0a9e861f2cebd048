"""What is optimised beside the Gaussians: poses, exposure, harmonics that grow, masks."""

from dataclasses import replace
from itertools import count

import pytest
import torch
from qgs_refine.refining import Extras, mean_psnr
from qgs_refine.scene import masked
from test_refining import RENDERER, cloud, ring

import qgs
from qgs.types import Cameras, Views


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every step takes a second."""
    readings = count()
    monkeypatch.setattr("qgs_refine.refining.perf_counter", lambda: float(next(readings)))


def photos(number: int = 5) -> Views:
    cameras = ring(number)
    return Views(RENDERER(cloud(60), cameras).rgb.clamp(0, 1), cameras)


def test_a_photo_with_a_wrong_pose_is_met_and_the_others_stay() -> None:
    """A small shift looks like a turn, so what the corrected camera sees is compared."""
    true = photos()
    wrong = true.cameras.c2w.clone()
    wrong[0, 2, :3, 3] += 0.04 * wrong[0, 2, :3, 0]  # a fiftieth of the distance
    given = replace(true, cameras=replace(true.cameras, c2w=wrong))

    def quality(c2w: torch.Tensor) -> float:
        cameras = replace(true.cameras, c2w=c2w)
        return mean_psnr(cloud(60), replace(true, cameras=cameras).select([2]), RENDERER)

    found = qgs.refine(cloud(60), given, 600, swept=0.0, extras=Extras(poses=True)).cameras.c2w
    plain = qgs.refine(cloud(60), given, 3, swept=0.0).cameras.c2w
    assert torch.equal(plain, wrong)
    assert quality(found) > quality(wrong) + 3
    moved = (found - wrong)[0, [0, 1, 3, 4], :3, 3].norm(dim=-1)
    assert 0 < moved.max() < 0.01
    turns = found[0, :, :3, :3]
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).expand(5, 3, 3), atol=1e-5, rtol=0)


def test_a_darker_photo_leaves_the_gaussians_alone() -> None:
    true = photos()
    images = true.images.clone()
    images[:, 2] *= 0.6
    given, scores = replace(true, images=images), list[float]()
    for exposure in (False, True):
        extras = Extras(exposure=exposure)
        found = qgs.refine(cloud(60), given, 300, swept=0.0, extras=extras).gaussians
        scores.append(mean_psnr(found, true, RENDERER))
    assert scores[1] > scores[0] + 0.5


def test_harmonics_grow_with_time() -> None:
    seen = list[int]()

    class Watching(torch.nn.Module):
        def forward(self, gaussians: qgs.Gaussians, cameras: Cameras) -> object:
            seen.append(0 if gaussians.sh is None else gaussians.sh.shape[-2])
            return RENDERER(gaussians, cameras)

    start, renderer = cloud(30, seed=1), Watching()
    result = qgs.refine(start, photos(), 40, renderer=renderer, extras=Extras(degree=2))
    assert result.gaussians.sh is not None
    assert result.gaussians.sh.shape == (1, 30, 8, 3)
    assert seen == sorted(seen)
    assert set(seen) == {0, 3, 8}
    # a start with harmonics of its own keeps them all
    given = replace(start, sh=torch.zeros(1, 30, 3, 3))
    kept = qgs.refine(given, photos(), 5, extras=Extras(degree=2)).gaussians.sh
    assert kept is not None
    assert kept.shape == (1, 30, 3, 3)


def test_what_masks_leave_out_is_background() -> None:
    views = photos(2)
    masks = torch.zeros(1, 2, 1, 24, 24)
    masks[..., :12] = 1
    found = masked(replace(views, masks=masks), (0.1, 0.2, 0.3)).images
    assert torch.equal(found[..., :12], views.images[..., :12])
    expected = torch.tensor([0.1, 0.2, 0.3])[:, None, None].expand(1, 2, 3, 24, 12)
    torch.testing.assert_close(found[..., 12:], expected)
    with pytest.raises(ValueError, match="--masks"):
        masked(views, (0.1, 0.2, 0.3))
