"""A forward pass never waits for the device; a layer of the framework imports none above it."""

import ast
from pathlib import Path

import pytest
import torch
from torch.overrides import TorchFunctionMode

import qgs
from qgs.composer import resolve
from qgs.types import Cameras, Views

ROOT = Path(__file__).parents[1]
MODELS = [
    *("tiny/tokengs", "tiny/locus", "tiny/ellipsoid", "tiny/gslrm", "tiny/c3g", "tiny/globalsplat"),
    *("tiny/mvsplat", "tiny/depthsplat", "tiny/landmark", "tiny/tokengs_latent"),
]
IMPORTERS = ("import_module", "__import__")
PUBLIC = {f"qgs.{name}" for name in qgs.__all__}


class HostWaits(TorchFunctionMode):
    """Collects calls for which the host of a CUDA device waits: reads of values, and copies to it.

    On the CPU a copy is seen by how its tensor was made: from numbers of Python, or without a
    device. `numpy` is none: CPU kernels use it, and it refuses tensors of another device.
    """

    READS = frozenset({"item", "tolist", "cpu", "__float__", "__int__", "__bool__", "__index__"})
    SIZES = frozenset({"nonzero", "unique", "masked_select"})
    COPIES = frozenset({"tensor", "new_tensor", "as_tensor", "from_numpy"})
    MAKERS = frozenset(
        {"arange", "linspace", "zeros", "ones", "full", "empty", "eye", "rand", "randn"}
    )

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_function__(self, func, types, args=(), kwargs=None):
        name, kwargs = getattr(func, "__name__", ""), kwargs or {}
        by_mask = name == "__getitem__" and any(
            isinstance(index, torch.Tensor) and index.dtype == torch.bool
            for index in (args[1] if isinstance(args[1], tuple) else args[1:2])
        )
        made = name in self.MAKERS and kwargs.get("device") is None
        if made or by_mask or name in self.READS | self.SIZES | self.COPIES:
            self.found.append(name)
        return func(*args, **kwargs)


def somewhere(size: int = 64) -> Views:
    c2w = torch.eye(4).repeat(1, 2, 1, 1)
    c2w[0, 1, 0, 3] = 0.3
    lens = torch.tensor([60.0, 60.0, size / 2, size / 2]).expand(1, 2, 4)
    return Views(torch.rand(1, 2, 3, size, size), Cameras(c2w, lens, (size, size)))


@pytest.mark.parametrize("name", MODELS)
def test_a_forward_pass_never_waits(name: str, tmp_path: Path) -> None:
    recipe = resolve(f"recipes/{name}.yaml")
    file = tmp_path / "model.safetensors"
    qgs.save(recipe.build_model(), file)
    model = qgs.load(file)
    views = somewhere(recipe.tree["data"]["image_size"][0])
    with torch.no_grad():
        model(views)  # the first one may warn of views that are unlike those of the training
        with HostWaits() as waits:
            model(views)
    assert waits.found == []


def test_waits_are_found() -> None:
    x = torch.ones(3)
    with HostWaits() as waits:
        _ = float(x.sum()), x.tolist(), bool(x.any()), x[x > 0], x.new_tensor([1.0])
        _ = torch.arange(3), torch.arange(3, device=x.device), torch.tensor(1.0), x[:, None]
    expected = ["__float__", "tolist", "__bool__", "__getitem__", "new_tensor", "arange", "tensor"]
    assert waits.found == expected


def test_no_module_reaches_a_higher_layer_by_name() -> None:
    """Neither by a name in a string nor through the table of public names.

    import-linter checks `import` statements, local ones too. A name that is put together from
    variables is found by neither.
    """
    found = []
    for file in sorted((ROOT / "qgs").rglob("*.py")):
        if file == ROOT / "qgs" / "__init__.py":
            continue  # its table of public names is the exception
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(IMPORTERS):
                by_name = any("qgs" in ast.unparse(argument) for argument in node.args)
            else:
                by_name = isinstance(node, ast.Attribute) and ast.unparse(node) in PUBLIC
            if by_name:
                found.append(f"{file.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node)}")
    assert found == []
