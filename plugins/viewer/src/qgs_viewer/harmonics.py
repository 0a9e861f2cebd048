"""Show spherical harmonics in the browser, where viser has one colour for each Gaussian."""

import base64
import json
from importlib.resources import files

import torch

from qgs.geometry.harmonics import rotated
from qgs_viewer.query_scene import QueryScene


def harmonics_script(scene: QueryScene) -> str:
    """Return scripts that add the spherical harmonics of `scene` to its colours in a page.

    The scripts must stand before viser's. They take 4 bytes for each coefficient of each Gaussian,
    and as much for its colour. Returns "" if the Gaussians have no harmonics.
    """
    gaussians = scene.gaussians
    if gaussians.sh is None:
        return ""
    sh = rotated(gaussians.sh[0].cpu(), scene.placement.rotation)
    colors = gaussians.colors[0, :, None].cpu()
    # viser's colours are from 0 to 1, which those beside harmonics may leave
    values = torch.cat([colors - colors.clamp(0, 1), sh], 1)
    most = values.abs().max().clamp_min(1e-6)
    # most coefficients are far smaller than the largest: 8 bits of their roots are closer
    roots = values.sign() * (values.abs() / most).sqrt()
    data = (127 * roots + 128).round().byte().numpy().tobytes()
    content = {
        "most": float(most),
        "count": values.shape[1],
        "data": base64.b64encode(data).decode(),
    }
    file = files("qgs_viewer") / "template" / "harmonics.html"
    code = file.read_text(encoding="utf-8")
    return f"<script>window.harmonics = {json.dumps(content)};</script>{code}"
