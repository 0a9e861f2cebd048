"""Training: the loop, one step, saved states, trackers."""
