"""Training: the loop, one step, the files of a run, and experiment trackers."""
