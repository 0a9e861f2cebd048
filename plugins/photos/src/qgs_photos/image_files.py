"""Photos in a folder, without cameras."""

from upath import UPath

from qgs.paths import listing

_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".avif", ".heic", ".heif")


def image_files(folder: UPath) -> list[UPath]:
    """Return the photos in a folder, by name."""
    files = [item for item in listing(folder) if not item.name.startswith(".")]
    photos = [item for item in files if item.name.lower().endswith(_SUFFIXES)]
    return sorted(photos, key=lambda item: item.name)
