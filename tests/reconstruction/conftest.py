from hand_made_model import cameras, model, views

__all__ = ["cameras", "model", "views"]
