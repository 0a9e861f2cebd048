"""Extensions of LocusGS: anchors with an ellipsoidal support, and Landmark."""
