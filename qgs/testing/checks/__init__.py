"""The checks, one file per family. Importing this package registers them all."""

from qgs.testing.checks import (
    basics,
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
    "basics",
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
