"""Plug-in `worlds`: procedural abstract scenes as training data, and models trained on them."""

from qgs.contracts import Plugin
from qgs_worlds.worlds.source import WorldsSource

plugin = Plugin(
    name="worlds",
    contract_version=1,
    components=(WorldsSource,),
    models={
        name: f"models/{name}.safetensors"
        for name in ("landmark-64", "landmark-128", "landmark-256", "locus-64", "tokengs-64")
    },
)
