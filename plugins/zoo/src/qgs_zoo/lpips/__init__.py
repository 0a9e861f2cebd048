"""LPIPS for qgs: distance of rendered and true images in VGG-16 features, as loss and metric."""

from qgs.contracts import Plugin
from qgs_zoo.lpips.network import Lpips, LpipsLoss

plugin = Plugin(name="lpips", contract_version=1, components=(LpipsLoss, Lpips))
