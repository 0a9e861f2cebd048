"""Query-based feed-forward 3D Gaussian splatting from composable, checked components.

model = qgs.compose("recipes/tiny/locus.yaml", overrides=["model.queries.count=128"])
result = qgs.reconstruct(model, "photos")  # or Views, in any world frame
prediction = model(views)  # in the model's own world frame
rendering = model.render(prediction.gaussians, cameras)
qgs.save(model, path); model = qgs.load(path)
"""

import os
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qgs.version import __version__ as __version__

if TYPE_CHECKING:
    from qgs.checkpoint.hub import from_pretrained, push_to_hub
    from qgs.checkpoint.model_file import load, save
    from qgs.contracts.plugin import CONTRACT_VERSION, Plugin
    from qgs.model import QueryGaussianModel
    from qgs.recipe import compose
    from qgs.reconstruction.reconstruct import reconstruct
    from qgs.reconstruction.result import Reconstruction
    from qgs.reconstruction.scene_formats import load_ply, save_ply
    from qgs.reconstruction.scenes import read_photos
    from qgs.reconstruction.trace import trace
    from qgs.types import Cameras, Gaussians, Prediction, QueryState, Rendering, Views

# PyPI's distribution `qgs`, a climate model, installs a package of the same name: in one folder the
# files of both would mix. Looked up by file name: importlib.metadata would double the import time.
for _other in Path(__file__).resolve().parents[1].glob("qgs-[0-9]*-info"):
    raise ImportError(
        f"another package named `qgs`, a climate model ({_other}), is in the folder of "
        "query-gaussians. Run `pip uninstall qgs`, then reinstall query-gaussians"
    )

os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
"""Setting of PyTorch's CPU allocator that uses huge pages for large tensors. Without it a forward
pass takes about 5 % longer. It has no effect if a tensor was allocated before qgs is imported. 0
switches it off."""

_ELSEWHERE = {
    "CONTRACT_VERSION": "qgs.contracts.plugin",
    "Plugin": "qgs.contracts.plugin",
    "QueryGaussianModel": "qgs.model",
    "Reconstruction": "qgs.reconstruction.result",
    "compose": "qgs.recipe",
    "from_pretrained": "qgs.checkpoint.hub",
    "load": "qgs.checkpoint.model_file",
    "load_ply": "qgs.reconstruction.scene_formats",
    "push_to_hub": "qgs.checkpoint.hub",
    "read_photos": "qgs.reconstruction.scenes",
    "reconstruct": "qgs.reconstruction.reconstruct",
    "save": "qgs.checkpoint.model_file",
    "save_ply": "qgs.reconstruction.scene_formats",
    "trace": "qgs.reconstruction.trace",
}
"""Module of each public name that is not in `qgs.types`."""

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
    "from_pretrained",
    "load",
    "load_ply",
    "push_to_hub",
    "read_photos",
    "reconstruct",
    "save",
    "save_ply",
    "trace",
]


def __getattr__(name: str) -> Any:
    """Import public names on first use, so that `import qgs` stays cheap."""
    if name not in __all__:
        raise AttributeError(f"module 'qgs' has no attribute {name!r}")
    return getattr(import_module(_ELSEWHERE.get(name, "qgs.types")), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
