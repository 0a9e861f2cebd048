"""What the other process of `qgs.testing.other_process` does: one request a line, one answer."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import sys
from types import ModuleType
from typing import Any

from qgs.testing.audit import Deed, watched

_deeds: list[Deed] = []
"""What was done by all that was imported so far."""

_modules: dict[str, ModuleType] = {}


def serve(threads: int) -> None:
    """Answer every request of the standard input."""
    import pydantic
    import torch

    torch.set_num_threads(threads)
    pydantic.create_model("First")  # now it looks for its plugins, and not for who is watched
    with watched() as deeds:  # the built-in components come along
        from qgs.contracts.component import MissingExtraError
        from qgs.testing.places import raised
    _deeds.extend(deeds)
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what components print must not pass for an answer
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = {"import": _import, "build": _build, "run": _run}[request["task"]](request)
        except MissingExtraError as error:
            answer = {"missing": str(error)}
        except (Exception, SystemExit) as error:
            answer = {"error": raised(error, request["file"])}
        print(json.dumps(answer), file=out, flush=True)


def _import(request: dict[str, Any]) -> dict[str, Any]:
    from qgs.composer.registry import package_of

    _module(request)
    package = package_of(request["file"])
    return {"deeds": [deed.text for deed in _deeds if deed.is_done_by(package)]}


def _build(request: dict[str, Any]) -> dict[str, Any]:
    """Digests of the parameters and buffers of a new instance."""
    from qgs.testing.trees import digests

    return {"digests": digests(_case(request).build(request["seed"]).state_dict())}


def _run(request: dict[str, Any]) -> dict[str, Any]:
    """Load weights into a new instance, run it on saved inputs, save the outputs."""
    import torch
    from safetensors.torch import load_file, save_file

    from qgs.testing.subjects import inputs_of
    from qgs.testing.trees import leaves, mapped

    case = _case(request)
    module = case.build(seed=99).eval()
    module.load_state_dict(load_file(request["weights"]))
    given = load_file(request["inputs"])
    # Cloned, since numbers at an address of another alignment may be summed in another order.
    inputs = mapped(inputs_of(case), lambda name, _: given[name].clone())
    with torch.no_grad():
        outputs = module(*inputs.values())
    save_file({n: x.contiguous().clone() for n, x in leaves(outputs).items()}, request["outputs"])
    return {}


def _case(request: dict[str, Any]) -> Any:
    from qgs.contracts import ModelDims
    from qgs.testing.case import Case

    component: Any = _module(request)
    for name in request["class"].split("."):
        component = getattr(component, name)
    config = component.Config.model_validate_json(request["config"])
    size = request["image_size"]
    return Case(config, ModelDims(*request["dims"]), tuple(size) if size else None)


def _module(request: dict[str, Any]) -> ModuleType:
    name = request["module"]
    if name in _modules:
        return _modules[name]
    with watched() as deeds:
        try:
            _modules[name] = importlib.import_module(name)
        except ImportError:
            _modules[name] = _from_file(name, request["file"])
    _deeds.extend(deeds)
    return _modules[name]


def _from_file(name: str, file: str) -> ModuleType:
    """A module that is no part of an importable package, such as a test."""
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ImportError(f"{name} cannot be imported from {file}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
