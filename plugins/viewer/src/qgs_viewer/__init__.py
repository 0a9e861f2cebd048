"""An interactive scene in the browser: Gaussians, photos, queries and what they read."""
