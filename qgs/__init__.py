"""Query-based feed-forward 3D Gaussian splatting from composable, checked components.

model = qgs.compose("recipes/tiny/locus.yaml", overrides=["model.queries.count=128"])
result = model.reconstruct("photos")  # or Views, in any world
prediction = model(views)  # in the model's own world
rendering = model.render(prediction.gaussians, cameras)
qgs.save(model, path); model = qgs.load(path)
"""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from contextlib import AbstractContextManager

    from qgs.analysis.reconstruction import Reconstruction
    from qgs.analysis.scenes import read_photos
    from qgs.composer import compose
    from qgs.contracts.plugin import CONTRACT_VERSION, Plugin
    from qgs.io.checkpoint import load, save
    from qgs.io.gaussians import load_ply, save_ply
    from qgs.model import QueryGaussianModel
    from qgs.types import Cameras, Gaussians, Prediction, QueryState, Rendering, Views

__version__ = "0.1.0"

DISTRIBUTIONS = {
    "qgs.plugins": {
        name: f"query-gaussians-{name}"
        for name in (
            *("locus", "ellipsoid", "landmark", "c3g", "gslrm", "globalsplat", "mvsplat"),
            *("tokengs2026", "dinov2", "lpips", "rooms", "datasets", "worlds"),
        )
    },
    "qgs.commands": {
        "data": "query-gaussians-datatools",
        "bench": "query-gaussians-bench",
        "scene": "query-gaussians-refine",
    }
    | dict.fromkeys(("poses", "video"), "query-gaussians-poses")
    | dict.fromkeys(("compare", "diff", "study"), "query-gaussians-studies")
    | dict.fromkeys(("convert", "export", "import"), "query-gaussians-published")
    | dict.fromkeys(("view", "demo", "report", "figures"), "query-gaussians-viewer")
    | dict.fromkeys(("new-plugin", "check-plugin"), "query-gaussians-plugintools"),
    "qgs.poses": {"folder": "query-gaussians-poses"},
    "qgs.videos": {"reconstruction": "query-gaussians-poses"},
    "qgs.jobs": {"slurm": "query-gaussians-studies"},
    "qgs.downloads": {"checkpoint": "query-gaussians-published"},
    "qgs.pages": {"gaussians": "query-gaussians-viewer"},
    "qgs.traces": {"queries": "query-gaussians-viewer"},
    "qgs.refiners": dict.fromkeys(
        ("gaussians", "reconstruction", "tuned", "tuner", "tuning_loss"), "query-gaussians-refine"
    ),
}
"""This repository's other distributions, by entry point; messages name those that are missing."""

# PyPI's distribution `qgs`, a climate model, installs a package of the same name: in one folder the
# files of both would mix. Looked up by file name: importlib.metadata would double the import time.
for _other in Path(__file__).resolve().parents[1].glob("qgs-[0-9]*-info"):
    raise ImportError(
        f"the climate model `qgs` ({_other}) is installed over query-gaussians. Run "
        "`pip uninstall qgs`, then reinstall query-gaussians"
    )

os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
"""PyTorch's CPU allocator then asks for huge pages for large tensors, if qgs is imported before it
has allocated any; with 4 KiB pages a forward pass takes some 5 % longer. Set it to 0 to refuse."""

_ELSEWHERE = {
    "CONTRACT_VERSION": "qgs.contracts.plugin",
    "Plugin": "qgs.contracts.plugin",
    "QueryGaussianModel": "qgs.analysis",
    "compose": "qgs.analysis",
    "Reconstruction": "qgs.analysis.reconstruction",
    "load": "qgs.analysis",
    "load_ply": "qgs.io.gaussians",
    "read_photos": "qgs.analysis.scenes",
    "save": "qgs.io.checkpoint",
    "save_ply": "qgs.io.gaussians",
}
"""Where public names come from that are not of `qgs.types`."""

__all__ = [
    "CONTRACT_VERSION",
    "Cameras",
    "Gaussians",
    "Plugin",
    "Prediction",
    "QueryGaussianModel",
    "QueryState",
    "Reconstruction",
    "Rendering",
    "Views",
    "compose",
    "load",
    "load_ply",
    "read_photos",
    "refine",
    "save",
    "save_ply",
    "trace",
]


def refine(gaussians: Gaussians, views: Views, seconds: float, **options: Any) -> Any:
    """Optimise Gaussians (1, G) of one scene on its photos `views` (1, V) for some seconds.

    Returns a `qgs_refine.RefinedScene`, whose `gaussians` are the result; `options` as in
    `qgs_refine.refine`. Raises ExtensionError where query-gaussians-refine is not installed.
    """
    from qgs.extensions import function

    return function("qgs.refiners", "gaussians")(gaussians, views, seconds, **options)


def trace(
    model: QueryGaussianModel,
    layers: Collection[int] | None = None,
    queries: Sequence[int] | None = None,
) -> AbstractContextManager[Any]:
    """Record states and attention weights of `queries` in `layers` (numbers; None: all of them).

    Gives a `qgs_viewer.trace.Trace` of the last forward pass inside the `with` block. Raises
    ValueError for layers or queries that do not exist, ExtensionError where
    query-gaussians-viewer is not installed.
    """
    from qgs.extensions import function

    return function("qgs.traces", "queries")(model, layers, queries)


def __getattr__(name: str) -> Any:
    """Import public names on first use, so that `import qgs` stays cheap."""
    if name not in __all__:
        raise AttributeError(f"module 'qgs' has no attribute {name!r}")
    return getattr(import_module(_ELSEWHERE.get(name, "qgs.types")), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
