"""MVSplat and DepthSplat for qgs: depth from a plane sweep, one Gaussian per pixel."""

from qgs.contracts import Plugin

plugin = Plugin(name="mvsplat", contract_version=1, components=())
