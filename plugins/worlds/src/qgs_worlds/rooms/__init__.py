"""Plug-in `rooms`: procedural furnished rooms as training data."""

from qgs.contracts import Plugin
from qgs_worlds.rooms.source import RoomsSource

plugin = Plugin(
    name="rooms",
    contract_version=1,
    components=(RoomsSource,),
    models={
        name: f"models/{name}.safetensors"
        for name in ("landmark-128", "landmark-64", "locus-128", "locus-64", "tokengs-64")
    },
)
