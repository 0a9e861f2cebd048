"""Procedural worlds for qgs: scenes without meaning, textures, light, cameras, ray casting."""

from qgs.contracts import Plugin
from qgs_worlds.source import WorldsSource

plugin = Plugin(
    name="worlds",
    contract_version=1,
    components=(WorldsSource,),
    models={
        "landmark-64": "models/landmark-64.safetensors",
        "landmark-128": "models/landmark-128.safetensors",
        "locus-64": "models/locus-64.safetensors",
        "tokengs-64": "models/tokengs-64.safetensors",
    },
)
