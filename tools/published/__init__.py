"""Computing here what files of numbers of the published code hold.

files: reading them. models, splats, losses: their tensors by our components. recording: what
modules compute on the way.
"""
