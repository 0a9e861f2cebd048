"""Pictures, which are arrays of pixels, and Matplotlib figures."""
