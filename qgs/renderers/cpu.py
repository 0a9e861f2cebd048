"""`qgs/cpu`: tiles of 16 x 16 pixels in numba, projection in autograd."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from qgs.contracts import Renderer, RendererConfig
from qgs.renderers.inputs import background_of, check_inputs, raise_precision
from qgs.renderers.projection import Splats, project
from qgs.renderers.reference import resolve
from qgs.types import Cameras, Gaussians, Rendering

_TILE = 16
_MIN_UNITS = 8  # units of work per call, so that a few large images still fill a few cores


class CpuRenderer(Renderer):
    """Fast on a CPU; the same bits on every run, whatever the number of threads.

    Rasterises in float32 on `torch.get_num_threads()` threads. float64 inputs are projected in
    float64 and come back in float64, at float32 accuracy.
    """

    name = "cpu"

    def __init__(self, config: RendererConfig) -> None:
        super().__init__(config)
        if find_spec("numba") is None:
            raise RuntimeError(
                "the renderer qgs/cpu needs numba, which is not installed: run "
                "`pip install qgs[cpu]`, or choose `renderer: {type: qgs/torch}` (much slower)"
            )

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        """See `Renderer`. Raises ValueError for tensors that are not on the CPU."""
        check_inputs(gaussians, cameras)
        if gaussians.means.device.type != "cpu":
            raise ValueError(
                f"qgs/cpu renders CPU tensors, got Gaussians on {gaussians.means.device}; move "
                "them with .to('cpu') or choose `renderer: {type: qgs/auto}`"
            )
        config = self.config
        with torch.autocast("cpu", enabled=False):
            gaussians, cameras = raise_precision(gaussians, cameras)
            splats = project(gaussians, cameras, config.near, config.far, config.dilation)
            sums = _Rasterise.apply(
                _packed(splats, gaussians.opacities.detach(), config.alpha_min),
                gaussians.opacities.float(),
                gaussians.colors.float(),
                cameras.size,
                (config.alpha_min, config.alpha_cap, config.transmittance_min),
            )
            backdrop = background_of(background, config.background, gaussians.means)
            return resolve(sums.to(gaussians.means.dtype), backdrop)


def _packed(splats: Splats, opacities: Tensor, alpha_min: float) -> Tensor:
    """Rows (B, V, G, 8) of the kernels: u, v, conic, depth, half extents.

    A contribution reaches alpha_min where the Mahalanobis distance is sqrt(2 ln(opacity /
    alpha_min)); half a pixel is added against rounding.
    """
    reach = (2 * (opacities / alpha_min).log()).clamp_min(0).sqrt()[:, None, :, None]
    extents = reach * splats.deviations + 0.5
    seen = splats.visible & (opacities >= alpha_min)[:, None]
    extents = torch.where(seen[..., None], extents, 0.0)
    fields = [splats.means, splats.conics, splats.depths[..., None], extents]
    return torch.cat([field.float() for field in fields], -1)


class _Rasterise(torch.autograd.Function):
    """Rows (B, V, G, 8), opacities (B, G), colors (B, G, 3) -> sums (B, V, 5, H, W)."""

    @staticmethod
    def forward(
        ctx: Any,
        splats: Tensor,
        opacities: Tensor,
        colors: Tensor,
        size: tuple[int, int],
        options: tuple[float, float, float],
    ) -> Tensor:
        from qgs.renderers import cpu_kernels as kernels

        splats, opacities, colors = splats.contiguous(), opacities.contiguous(), colors.contiguous()
        sums = splats.new_empty((*splats.shape[:2], kernels.SUMS, *size))
        scene, out = _arrays(splats, opacities, colors), sums.detach().numpy()
        limits = _float32(options)

        def unit(image: tuple[int, int], rows: tuple[int, int], part: int) -> None:
            kernels.forward_unit(*_of(scene, image), rows, limits, out[image])

        _run(unit, splats.shape[:2], size)
        ctx.save_for_backward(splats, opacities, colors, sums)
        ctx.options = options
        return sums

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        from qgs.renderers import cpu_kernels as kernels

        splats, opacities, colors, sums = ctx.saved_tensors
        batch, views, count = splats.shape[:3]
        size = sums.shape[-2:]
        parts = len(_stripes(batch * views, size[0]))
        grads = splats.new_zeros((batch, views, parts, count, kernels.GRADIENTS))
        scene, out = _arrays(splats, opacities, colors), grads.numpy()
        values, given = sums.detach().numpy(), slopes[0].contiguous().numpy()
        limits = _float32(ctx.options)

        def unit(image: tuple[int, int], rows: tuple[int, int], part: int) -> None:
            kernels.backward_unit(
                *_of(scene, image), rows, limits, values[image], given[image], out[image][part]
            )

        _run(unit, (batch, views), size)
        grads = grads.sum(2) if parts > 1 else grads[:, :, 0]
        no_extent = torch.nn.functional.pad(grads[..., :6], (0, 2))
        shared = grads[..., 6:].sum(1)
        return no_extent, shared[..., 0], shared[..., 1:], None, None


def _float32(options: tuple[float, ...]) -> tuple[Any, ...]:
    import numpy as np

    return tuple(np.float32(value) for value in options)


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    return tuple(tensor.detach().numpy() for tensor in tensors)


def _of(scene: tuple[Any, ...], image: tuple[int, int]) -> tuple[Any, Any, Any]:
    splats, opacities, colors = scene
    return splats[image], opacities[image[0]], colors[image[0]]


def _stripes(images: int, height: int) -> list[tuple[int, int]]:
    """Ranges of tile rows: one per image, or several when there are few images."""
    rows = -(-height // _TILE)
    parts = min(rows, -(-_MIN_UNITS // max(images, 1)))
    edges = [rows * part // parts for part in range(parts + 1)]
    return list(pairwise(edges))


def _run(
    unit: Callable[[tuple[int, int], tuple[int, int], int], None],
    images: tuple[int, ...],
    size: tuple[int, ...],
) -> None:
    """Run every unit of work; each writes to memory of its own, so their order does not matter."""
    batch, views = images
    work = [
        ((b, v), rows, part)
        for b in range(batch)
        for v in range(views)
        for part, rows in enumerate(_stripes(batch * views, size[0]))
    ]
    threads = min(torch.get_num_threads(), len(work))
    if threads <= 1:
        for item in work:
            unit(*item)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda item: unit(*item), work))
