"""Procedural rooms for qgs: plan, furniture, materials, ray casting, camera paths."""

from qgs.contracts import Plugin
from qgs_worlds.rooms.source import RoomsSource

plugin = Plugin(
    name="rooms",
    contract_version=1,
    components=(RoomsSource,),
    models={
        "landmark-128": "models/landmark-128.safetensors",
        "landmark-64": "models/landmark-64.safetensors",
        "locus-128": "models/locus-128.safetensors",
        "locus-64": "models/locus-64.safetensors",
        "tokengs-64": "models/tokengs-64.safetensors",
    },
)
