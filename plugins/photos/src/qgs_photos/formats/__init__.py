"""Files of Gaussians other than PLY: glTF with cameras, .spz, .sog, compressed PLY."""
