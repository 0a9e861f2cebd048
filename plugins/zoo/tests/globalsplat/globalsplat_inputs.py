"""The small recipe."""

TINY = "tiny/globalsplat.yaml"
SMALL = (
    *("model.width=32", "model.heads=2", "model.decoder.depth=1", "model.supervision.layers=[1]"),
    *("model.queries.count=40", "model.encoder.patch_size=4", "data.image_size=[16, 16]"),
)
