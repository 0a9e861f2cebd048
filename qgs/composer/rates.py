"""Learning-rate factors: which parameters the patterns of `optimizer.parts` name."""

from fnmatch import fnmatchcase

from torch import nn

from qgs.composer.decode import Chosen
from qgs.composer.errors import Problems
from qgs.composer.nodes import KeyPath, MapNode, find
from qgs.composer.places import near_pattern
from qgs.contracts import OptimizerConfig
from qgs.model import QueryGaussianModel


def rate_factors(module: nn.Module, optimizer: Chosen) -> dict[str, float]:
    """Factor of the learning rate for every parameter of `module`, by name; 1 where none is given.

    module: a model, which leaves patterns of `losses` unchecked, or what holds both. A shared
    parameter goes by its first name. Raises RecipeError.
    """
    config, node, problems = optimizer.config, optimizer.place.node, Problems()
    written = node if isinstance(node, MapNode) else MapNode(optimizer.place.origin)
    model = next(m for m in module.modules() if isinstance(m, QueryGaussianModel))
    factors = {name: 1.0 for name, _ in module.named_parameters()}
    known: dict[int, dict[KeyPath, list[str]]] = {}  # names below a path, by its length
    for name in factors:
        for path in _paths(name.removeprefix("model."), model):
            for end in range(1, len(path) + 1):
                known.setdefault(end, {}).setdefault(path[:end], []).append(name)
    for pattern, factor in config.parts.items() if isinstance(config, OptimizerConfig) else ():
        wanted = pattern.removeprefix("model.").split(".")
        below = known.get(len(wanted), {}).items()
        named = [n for p, names in below if all(map(fnmatchcase, p, wanted)) for n in names]
        factors |= dict.fromkeys(named, factor)
        if not named and (module is not model or wanted[0] != "losses"):
            parts = [path for paths in known.values() for path in paths]
            reason = f"the pattern `{pattern}` matches no parameter of the model"
            outermost = ", ".join(dict.fromkeys(path[0] for path in parts))
            fix = near_pattern(pattern, parts) or f"its parts: {outermost}"
            _, origin, _ = find(written, ("parts", pattern))
            problems.add(origin, f"optimizer.parts.{pattern}", reason, fix)
    problems.raise_any()
    return factors


def _paths(name: str, model: QueryGaussianModel) -> list[KeyPath]:
    """Paths of a parameter: its own, and those under which a recipe has its component."""
    path = tuple(name.split("."))
    if path[0] == "decoder":
        return [path, ("decoder", "layers", *path[1:]), ("decoder", *path[2:])]
    if path[0] != "refinements":
        return [path]
    below = ("refinement", *path[2:])
    layers = [str(n) for n, at in enumerate(model.refinement_of) if str(at) == path[1]]
    return [path, ("decoder", *below), *(("decoder", "layers", n, *below) for n in layers)]
