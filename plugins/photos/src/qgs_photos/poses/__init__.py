"""Camera poses of photos and videos, and videos of camera paths."""
