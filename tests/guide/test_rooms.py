"""The picture of the rooms shows the imports of today."""

from rooms import PICTURE, drawn


def test_the_picture_is_fresh():
    assert PICTURE.read_text(encoding="utf-8") == drawn(), "run python tools/rooms.py"
