"""The plugin `qgs`: the components that ship with the framework."""

from __future__ import annotations

import qgs.components
import qgs.data
import qgs.losses
import qgs.renderers
from qgs.contracts import CONTRACT_VERSION, Plugin

BUILTIN = Plugin(
    name="qgs",
    contract_version=CONTRACT_VERSION,
    components=(
        *qgs.components.COMPONENTS,
        *qgs.renderers.COMPONENTS,
        *qgs.losses.COMPONENTS,
        *qgs.data.COMPONENTS,
    ),
    layouts=(qgs.components.TOKENGS,),
    examples=(
        qgs.components.LayerSupervision.Config(layers=(1, 2)),
        qgs.data.ChunksSource.Config(path="chunks"),  # type: ignore[call-arg]
        qgs.data.Dl3dvSource.Config(path="dl3dv"),  # type: ignore[call-arg]
        qgs.data.PhotosSource.Config(path="photos"),  # type: ignore[call-arg]
    ),
)
