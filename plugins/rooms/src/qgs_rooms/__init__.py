"""Procedural rooms for qgs: plan, furniture, materials, ray casting, camera paths."""

from qgs.contracts import Plugin, ShippedModel
from qgs_rooms.source import RoomsSource

plugin = Plugin(
    name="rooms",
    contract_version=1,
    components=(RoomsSource,),
    models={
        "locus-64": ShippedModel(
            "models/locus-64.safetensors", "LocusGS on rooms of 64 x 64 pixels, 2 input views"
        ),
        "tokengs-64": ShippedModel(
            "models/tokengs-64.safetensors", "TokenGS on rooms of 64 x 64 pixels, 2 input views"
        ),
    },
)
