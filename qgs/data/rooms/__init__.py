"""Procedural rooms: layout, textures, ray casting, camera paths."""

from qgs.data.rooms.source import RoomsConfig, RoomsSource

__all__ = ["RoomsConfig", "RoomsSource"]
