"""`qgs/cpu`, a renderer for CPUs, compiled by numba, that blends tiles of 16 x 16 pixels."""

from itertools import pairwise, product
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from qgs.contracts import Renderer, RendererConfig
from qgs.machine import in_threads
from qgs.renderers.reference import CLAMP_MARGIN, resolve
from qgs.types import Cameras, Gaussians, Rendering, Size

_TILE = 16
# Gaussians per unit of the projection.
_CHUNK = 512
# Units of work per call, so that a few large images still fill a few cores.
_MIN_UNITS = 8

_Part = tuple[int, tuple[int, int]]


class CpuRenderer(Renderer):
    """Fast renderer for CPUs. Results are bitwise equal for every run and number of threads.

    It computes in float32 on `torch.get_num_threads()` threads. float64 inputs give float64 results
    with float32 accuracy. Gradients cannot be differentiated again.
    """

    name = "cpu"
    devices = ("cpu",)

    def draw(
        self, gaussians: Gaussians, cameras: Cameras, channels: Tensor, backdrop: Tensor
    ) -> Rendering:
        """Render every scene from each of its cameras; raise ValueError for tensors off the CPU."""
        if gaussians.means.device.type != "cpu":
            raise ValueError(
                f"qgs/cpu renders CPU tensors, got Gaussians on {gaussians.means.device}; move "
                "them with .to('cpu') or choose `renderer: {type: qgs/auto}`"
            )
        count = channels.shape[-1]
        given = (
            gaussians.opacities, gaussians.means, gaussians.scales, gaussians.quats,
            cameras.c2w, cameras.intrinsics,
        )  # fmt: skip
        geometry = [tensor.float() for tensor in given]
        # Three at a time, as if all were colours.
        parts = [
            _Splat.apply(three.float(), *geometry, cameras.size, self.config)
            for three in F.pad(channels, (0, -count % 3)).split(3, -1)
        ]
        blended = torch.cat([part[:, :, :3] for part in parts], 2)[:, :, :count]
        sums = torch.cat([blended, parts[0][:, :, 3:]], 2)
        return resolve(sums.to(gaussians.means.dtype), backdrop)


class _Splat(torch.autograd.Function):
    """Autograd function that projects Gaussians and sums their values at each pixel, with weights.

    Returns sums (B, V, 5, H, W) of r, g, b, depth and 1, each multiplied by the blending weight of
    the Gaussian at the pixel. Inputs: colors (B, V, G, 3) or (B, 1, G, 3), opacities, means,
    scales, quats, c2w, intrinsics; image size and options of the renderer.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        from qgs.kernels import rasterisation as kernels
        from qgs.kernels.projection import project_unit

        *tensors, size, config = inputs
        tensors = [tensor.contiguous() for tensor in tensors]
        colors, opacities, *geometry = _arrays(*tensors)
        batch, views = tensors[5].shape[:2]
        splats = tensors[0].new_empty((batch, views, opacities.shape[1], kernels.SPLAT_FIELDS))
        sums = splats.new_empty((batch, views, kernels.SUMS, *size))
        rows, out = _arrays(splats, sums)
        ctx.plan = _planned(config, size, rows)
        projection, blending, chunks, stripes = ctx.plan

        def project(scene: int, chunk: _Part) -> None:
            own = [array[scene] for array in geometry]
            project_unit(*own, opacities[scene], chunk[1], projection, rows[scene])

        def blend(scene: int, view: int, stripe: _Part) -> None:
            image = scene, view
            look = orders[image], opacities[scene], colors[scene, view % colors.shape[1]]
            seen = out[image]
            kernels.blend_unit(
                rows[image], *look, stripe[1], blending, seen, seen, rows[image], False
            )

        in_threads(project, product(range(batch), chunks))
        by_depth = splats[..., 5].argsort(stable=True)
        orders = by_depth.numpy()
        in_threads(blend, product(range(batch), range(views), stripes))
        ctx.save_for_backward(*tensors, splats, by_depth, sums)
        return sums

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        from qgs.kernels import rasterisation as kernels
        from qgs.kernels.projection import CAMERA_GRADIENTS, project_backward_unit

        saved = ctx.saved_tensors
        colors, opacities, *geometry, rows, orders, sums = _arrays(*saved)
        batch, views, count, _ = rows.shape
        projection, blending, chunks, stripes = ctx.plan
        # Each stripe sums its own gradients, in an order that does not depend on threads.
        grads = np.zeros((batch, views, len(stripes), count, kernels.GRADIENTS), np.float32)
        given = slopes[0].contiguous().numpy()
        of_inputs = [torch.empty_like(tensor) for tensor in saved[1:5]]
        of_opacities, *of_geometry = _arrays(*of_inputs)
        # In float64: thousands of splats of either sign nearly cancel in a camera's gradient.
        of_cameras = np.zeros((batch, len(chunks), views, CAMERA_GRADIENTS))
        wants_cameras = any(ctx.needs_input_grad[5:7])

        def blend(scene: int, view: int, stripe: _Part) -> None:
            image = scene, view
            look = orders[image], opacities[scene], colors[scene, view % colors.shape[1]]
            part, tile_rows = stripe
            kernels.blend_unit(
                rows[image], *look, tile_rows, blending, sums[image], given[image],
                grads[image][part], True,
            )  # fmt: skip

        def project(scene: int, chunk: _Part) -> None:
            part, bounds = chunk
            own = [array[scene] for array in geometry]
            of_own = [array[scene] for array in of_geometry]
            project_backward_unit(
                *own, bounds, projection, rows[scene], summed[scene], wants_cameras, *of_own,
                of_opacities[scene], of_cameras[scene, part],
            )  # fmt: skip

        in_threads(blend, product(range(batch), range(views), stripes))
        summed = grads.sum(2)
        in_threads(project, product(range(batch), chunks))
        of_colors = summed[..., -3:]
        if colors.shape[1] < views:
            of_colors = of_colors.sum(1, keepdims=True)
        of_inputs = [torch.from_numpy(of_colors), *of_inputs]
        if not wants_cameras:
            return *of_inputs, None, None, None, None
        summed = torch.from_numpy(of_cameras.sum(1)).float()
        rotation, position, lens = summed.split([9, 3, 4], -1)
        pose = torch.cat([rotation.unflatten(-1, (3, 3)), position[..., None]], -1)
        return *of_inputs, F.pad(pose, (0, 0, 0, 1)), lens, None, None


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    return tuple(tensor.detach().numpy() for tensor in tensors)


def _planned(config: RendererConfig, size: Size, splats: Any) -> tuple[Any, ...]:
    """Return options for the kernels of projection and of blending, and units of parallel work.

    The options are float32. The units are numbered ranges of Gaussians, and of rows of tiles. The
    rows of an image are one range, unless there are few images.
    """
    projection = (config.near, config.far, config.dilation, config.alpha_min, CLAMP_MARGIN, *size)
    blending = (config.alpha_min, config.alpha_cap, config.transmittance_min)
    options = [tuple(map(np.float32, limits)) for limits in (projection, blending)]
    batch, views, count, _ = splats.shape
    chunks = pairwise([*range(0, count, _CHUNK), count])
    rows = -(-size[0] // _TILE)
    stripes = min(rows, -(-_MIN_UNITS // max(batch * views, 1)))
    edges = [rows * part // stripes for part in range(stripes + 1)]
    return *options, list(enumerate(chunks)), list(enumerate(pairwise(edges)))
