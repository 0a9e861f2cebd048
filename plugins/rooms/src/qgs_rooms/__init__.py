"""Procedural rooms for qgs: plan, furniture, materials, ray casting, camera paths."""

from qgs.contracts import Plugin
from qgs_rooms.source import RoomsSource

plugin = Plugin(name="rooms", contract_version=1, components=(RoomsSource,))
