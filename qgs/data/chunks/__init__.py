"""RealEstate10K-style chunks: reading, listing and writing them.

The layout is pixelSplat's (data release of RealEstate10K and ACID, and DepthSplat's of DL3DV):
PATH/{train,test}/index.json maps a scene's key to a file such as 000000.torch, which is a list of
mappings, one a scene, with `key`, `url`, `timestamps` (V,), `cameras` (V, 18) float32 and `images`,
a list of V uint8 tensors with the bytes of JPEG or PNG files. A row of `cameras` is fx, fy, cx, cy
divided by the image's width and height, two numbers without use, and the rows of the 3 x 4 OpenCV
world-to-camera matrix.

`qgs` adds keys that other readers ignore: `names` (V strings), `sizes` (V, 2), the height and width
of every image, `masks`, a list of V uint8 tensors with the bytes of PNG files, empty where a frame
has none, and `held_out`, the frames that training is not to see.
"""

from qgs.data.chunks.source import ChunkScene, ChunksSource

__all__ = ["ChunkScene", "ChunksSource"]
