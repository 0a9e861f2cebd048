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
MODELS = ["tokengs", "locus", "ellipsoid", "gslrm", "c3g", "globalsplat", "mvsplat", "depthsplat"]
IMPORTERS = ("import_module", "__import__")
PUBLIC = {f"qgs.{name}" for name in qgs.__all__}


class HostReads(TorchFunctionMode):
    """Counts calls that make the host wait for values of a device.

    `numpy` is none: CPU kernels use it, and it refuses tensors of another device.
    """

    NAMES = frozenset({"item", "tolist", "cpu", "__float__", "__int__", "__bool__", "__index__"})
    count = 0

    def __torch_function__(self, func, types, args=(), kwargs=None):
        self.count += getattr(func, "__name__", "") in self.NAMES
        return func(*args, **(kwargs or {}))


def somewhere(size: int = 64) -> Views:
    c2w = torch.eye(4).repeat(1, 2, 1, 1)
    c2w[0, 1, 0, 3] = 0.3
    lens = torch.tensor([60.0, 60.0, size / 2, size / 2]).expand(1, 2, 4)
    return Views(torch.rand(1, 2, 3, size, size), Cameras(c2w, lens, (size, size)))


@pytest.mark.parametrize("name", MODELS)
def test_a_forward_pass_reads_no_value(name: str, tmp_path: Path) -> None:
    recipe = resolve(f"recipes/tiny/{name}.yaml")
    file = tmp_path / "model.safetensors"
    qgs.save(recipe.build_model(), file)
    model = qgs.load(file)
    views = somewhere(recipe.tree["data"]["image_size"][0])
    with torch.no_grad():
        model(views)  # the first one may warn of views that are unlike those of the training
        with HostReads() as reads:
            model(views)
            assert reads.count == 0
            (float(views.images.sum()), views.images[0].tolist(), bool(views.images.any()))
            assert reads.count >= 3, "the count counts"


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
