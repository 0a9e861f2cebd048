from reconstructing import checkpoint, photos

__all__ = ["checkpoint", "photos"]
