"""Reconstructions to look at: a scene in the browser with its queries, and figures for papers."""
