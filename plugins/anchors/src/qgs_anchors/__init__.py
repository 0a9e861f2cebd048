"""Two extensions of LocusGS, which gives each query a 3D anchor with a radius.

`ellipsoid` gives anchors a rotation and three radii. `landmark` starts anchors on surfaces that the
photos show.
"""
