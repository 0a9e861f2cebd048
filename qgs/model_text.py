"""Text descriptions of models: their sizes, and the component in each slot."""

from typing import Any

from torch import nn

from qgs.contracts import LAYER_SLOTS, SUBLAYER_SLOTS


def parameter_counts(model: Any) -> dict[str, int]:
    """Count the parameters of each component of a model.

    Keys are slots, such as `head` and `decoder.self_attention`. Counts of the decoder are sums over
    all layers. `decoder.layer` counts the parameters of layers that belong to no sublayer.
    """
    sublayers: dict[str, int] = {}
    for slot in SUBLAYER_SLOTS:
        modules = [getattr(layer, slot) for layer in model.decoder if hasattr(layer, slot)]
        if modules:
            sublayers[f"decoder.{slot}"] = sum(map(_count, modules))
    return {
        "encoder": _count(model.encoder),
        "queries": _count(model.queries),
        "decoder.layer": _count(model.decoder) - sum(sublayers.values()),
        **sublayers,
        "decoder.refinement": _count(model.refinements),
        "feedback": _count(model.feedback),
        "head": _count(model.head),
        "centers": _count(model.centers),
    }


def _count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def model_text(model: Any) -> str:
    """Describe a model: a line of sizes, then for each slot its component and parameter count."""
    rows = slot_rows(model)
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [f"  {slot:<{wide[0]}}  {kind:<{wide[1]}}  {n:>{wide[2]}}" for slot, kind, n in rows]
    return "\n".join([heading(model), *(line.rstrip() for line in lines)])


def heading(model: Any) -> str:
    """Return one line: the model's class, device, and numbers of parameters, layers and queries."""
    parts = [f"{_count(model):,} parameters", f"{len(model.decoder)} decoder layers"]
    # Queries that depend on the photos have no number of their own.
    if count := model.queries.count:
        parts.append(f"{count:,} queries of {model.head.gaussians_per_query} Gaussians")
    device = next((parameter.device for parameter in model.parameters()), "cpu")
    return f"{type(model).__name__}: {', '.join(parts)}, on {device}"


def slot_rows(model: Any) -> list[tuple[str, str, str]]:
    """Return table rows: each slot, the types of its components, and their number of parameters.

    Types, such as `qgs/free`, come from the recipe. For a model without a recipe, rows show class
    names in place of types, and "" for slots of decoder layers.
    """
    counts = {name: f"{count:,}" for name, count in parameter_counts(model).items()}
    counts |= {"supervision": "", "renderer": ""}
    kinds = {name: _types(model, name.removeprefix("decoder.")) for name in counts}
    return [(name, ", ".join(dict.fromkeys(kinds[name])), count) for name, count in counts.items()]


def _types(model: Any, slot: str) -> list[str]:
    """Return the types of the components in `slot`; for a slot of layers, one type per layer."""
    if model.recipe is None:
        return [type(getattr(model, slot)).__name__] if hasattr(model, slot) else []
    tree = model.recipe["model"]
    places = [tree]
    if slot in LAYER_SLOTS:
        # A layer has its own component, or else the common one.
        decoder = tree["decoder"]
        own = decoder.get("layers", {})
        places = [decoder | own.get(str(index), {}) for index in range(len(model.decoder))]
    return [place[slot]["type"] for place in places if place.get(slot)]
