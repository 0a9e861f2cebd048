"""List the image files of a folder."""

from upath import UPath

from qgs.paths import listing

_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".avif", ".heic", ".heif")


def image_files(folder: UPath) -> list[UPath]:
    """Return the image files in a folder, sorted by name, without hidden files."""
    files = [item for item in listing(folder) if not item.name.startswith(".")]
    photos = [item for item in files if item.name.lower().endswith(_SUFFIXES)]
    return sorted(photos, key=lambda item: item.name)
