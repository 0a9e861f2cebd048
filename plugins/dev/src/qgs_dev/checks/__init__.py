"""The checks, by subject. Importing this package registers them all."""

from qgs_dev.checks import (  # noqa: F401
    attention,
    basics,
    encoders,
    fields,
    gradients,
    judging,
    objective,
    options,
    parameters,
    precision,
    rendering,
    slots,
    state,
    symmetry,
)
