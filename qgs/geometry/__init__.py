"""Cameras, rays and rotations. Everything here computes in float32 or better."""
