"""Reconstruction: from photos in any world to a scene, its files, and a look inside models."""
