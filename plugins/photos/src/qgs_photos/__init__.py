"""Photo formats, checks of data, camera poses and refinement of scenes."""
