import torch

from qgs.analysis.saving import orbit
from qgs.geometry.poses import look_at


def test_the_loop_is_smooth_closed_and_rigid_and_passes_between_the_inputs(cameras):
    path = orbit(cameras, depth=1.0, frames=60)
    assert path.shape == (1, 60)
    rotation = path.c2w[0, :, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(60, 3, 3))
    assert (torch.linalg.det(rotation) > 0).all()
    eyes = path.c2w[0, :, :3, 3]
    steps = (eyes.roll(-1, 0) - eyes).norm(dim=-1)
    assert steps.max() < 3 * steps.mean()
    assert 0.1 < eyes[:, 0].mean() < 0.2
    assert orbit(cameras[:, :1], depth=1.0, frames=8).c2w.isfinite().all()


def test_look_at_puts_the_target_in_the_middle():
    eye, target = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([4.0, -1.0, 5.0])
    c2w = look_at(eye, target - eye, torch.tensor([0.0, 1.0, 0.0]))
    seen = torch.linalg.inv(c2w) @ torch.cat([target, torch.ones(1)])
    torch.testing.assert_close(seen[:2], torch.zeros(2), atol=1e-5, rtol=0)
    assert seen[2] > 0
