"""A forward pass never waits for the device."""

import torch
from odd_views import odd_views
from torch.overrides import TorchFunctionMode

import qgs
from qgs.recipe import resolve

MODELS = "tokengs locus ellipsoid gslrm c3g globalsplat mvsplat depthsplat landmark tokengs_latent"
WAITING = """
item tolist cpu __float__ __int__ __bool__ __index__ nonzero unique masked_select
tensor new_tensor as_tensor from_numpy
"""
"""What reads values, and what copies numbers."""
MAKERS = "arange linspace zeros ones full empty eye rand randn"


class HostWaits(TorchFunctionMode):
    """Collects calls for which the host of a CUDA device waits: reads of values, and copies to it.

    On the CPU a copy is seen by how its tensor was made: from numbers of Python, or without a
    device. `numpy` is none: CPU kernels use it, and it refuses tensors of another device.
    """

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_function__(self, func, types, args=(), kwargs=None):
        name = getattr(func, "__name__", "")
        kwargs = kwargs or {}
        by_mask = name == "__getitem__" and any(
            isinstance(index, torch.Tensor) and index.dtype == torch.bool
            for index in (args[1] if isinstance(args[1], tuple) else args[1:2])
        )
        made = name in MAKERS.split() and kwargs.get("device") is None
        if made or by_mask or name in WAITING.split():
            self.found.append(name)
        return func(*args, **kwargs)


@torch.no_grad()
def test_a_forward_pass_never_waits(tmp_path):
    for name in MODELS.split():
        recipe = resolve(f"tiny/{name}.yaml")
        model = recipe.build_model().eval()
        if name == "tokengs":  # one that was loaded also looks whether views are unlike its own
            qgs.save(model, tmp_path / "model.safetensors")
            model = qgs.load(tmp_path / "model.safetensors")
        views = odd_views(2, *recipe.tree["data"]["image_size"], 1)
        model(views)  # the first time it may warn of them
        with HostWaits() as waits:
            model(views)
        assert not waits.found, name
    with waits:
        float(views.images[views.images > 0].sum())
    assert waits.found == ["__getitem__", "__float__"]
