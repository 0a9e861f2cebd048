"""List the image files of a folder."""

from upath import UPath

from qgs.paths import listing

_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".avif", ".heic", ".heif")


def image_files(folder: UPath) -> list[UPath]:
    """Return the image files in a folder, sorted by name, without hidden files."""
    photos = (
        item
        for item in listing(folder)
        if item.name.lower().endswith(_SUFFIXES) and not item.name.startswith(".")
    )
    return sorted(photos, key=str)
