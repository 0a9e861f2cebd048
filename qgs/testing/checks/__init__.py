"""The checks, one file per family. Importing this package registers them all."""

from qgs.testing.checks import (
    building,
    compiling,
    composing,
    configuration,
    determinism,
    equivariance,
    extremes,
    gradients,
    invariance,
    precision,
    reading,
    serialisation,
    sizes,
    slots,
    state,
)

__all__ = [
    "building",
    "compiling",
    "composing",
    "configuration",
    "determinism",
    "equivariance",
    "extremes",
    "gradients",
    "invariance",
    "precision",
    "reading",
    "serialisation",
    "sizes",
    "slots",
    "state",
]
