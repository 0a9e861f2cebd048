"""Files: checkpoints, PLY, pictures; each whole or not at all."""
