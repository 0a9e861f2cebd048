"""Compute camera poses of photos and videos, and render videos of camera paths."""
