"""DINOv2 for qgs: the vision transformer, and an encoder that uses it."""

from qgs.contracts import Plugin
from qgs_zoo.dinov2.vit import DinoMultiViewViT, VitConfig

_SMALL = VitConfig(width=32, depth=2, heads=2)

plugin = Plugin(
    name="dinov2",
    contract_version=1,
    components=(DinoMultiViewViT,),
    examples=(DinoMultiViewViT.Config(patch_size=8, depth=1, vit=_SMALL),),
)
