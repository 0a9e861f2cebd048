"""Pictures (arrays of pixels) and Matplotlib figures."""
