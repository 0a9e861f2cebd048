from hand_made_model import cameras, model, views
from reconstructing import photos

__all__ = ["cameras", "model", "photos", "views"]
