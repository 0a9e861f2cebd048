import torch
from torch.testing import assert_close
from walk import assert_rigid

from qgs.reconstruction.saving import orbit


def test_the_loop_is_smooth_closed_and_rigid_and_passes_between_the_inputs(cameras):
    c2w = orbit(cameras, depth=1.0, frames=60).c2w[0]
    eyes = c2w[:, :3, 3]
    assert_rigid(c2w)
    steps = (eyes.roll(-1, 0) - eyes).norm(dim=-1)
    assert steps.max() < 3 * steps.mean()
    assert 0.1 < eyes[:, 0].mean() < 0.2


def test_one_input_is_enough_and_what_it_sees_stays_in_the_middle(cameras):
    c2w = orbit(cameras[:, :1], depth=2.0, frames=8).c2w[0]
    seen = torch.linalg.inv(c2w) @ torch.tensor([0.0, 0, 2, 1])
    assert_close(seen[:, :2], torch.zeros(8, 2))
    assert (seen[:, 2] > 0).all()
