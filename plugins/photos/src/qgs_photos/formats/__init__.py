"""Files of Gaussians other than PLY: glTF with cameras, .spz, .sog, compressed PLY."""

import torch

TURN = torch.tensor([1.0, -1, -1, 1]).double().diag()
"""Pose (4, 4) that turns right, down, forward, the axes of qgs, to right, up, back, and back."""
