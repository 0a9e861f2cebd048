"""Beyond LocusGS: anchors with an ellipsoid for a support, and Landmark."""
