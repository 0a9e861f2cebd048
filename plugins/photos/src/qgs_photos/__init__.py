"""Photo formats, checks of data sets, camera poses from photos, and refinement of scenes."""
