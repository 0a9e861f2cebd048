"""Which layers a figure shows, and what they are called."""


def chosen_layers(depth: int, most: int, first: int = 1) -> list[int]:
    """At most `most` layers from `first` to `depth`, evenly, both among them."""
    count = min(most, depth - first + 1)
    if count < 2:
        return [depth]
    return [first + round(i * (depth - first) / (count - 1)) for i in range(count)]


def layer_name(layer: int) -> str:
    """Of a state; layer 0 is the learned start."""
    return f"after layer {layer}" if layer else "learned start"
