"""From a camera to a scene: formats, checks, poses, refinement."""
