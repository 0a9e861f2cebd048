"""DL3DV: scenes as zip archives or folders, as DL3DV-10K and its benchmark publish them."""

from qgs.data.dl3dv.source import Dl3dvSource

__all__ = ["Dl3dvSource"]
