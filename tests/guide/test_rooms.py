"""Pictures of the code, and the page that begins with them, show the code of today."""

import re

from rooms import PICTURE, ROOT, drawn


def test_the_picture_is_fresh():
    assert PICTURE.read_text() == drawn(), "run python tools/rooms.py"


def test_files_that_are_named_exist():
    for page in (*PICTURE.parent.glob("*.svg"), ROOT / "docs/design.md"):
        for name in re.findall(r"(?<![/\w])(?<!python )(?:qgs/)?([\w/]+\.py)", page.read_text()):
            assert (ROOT / "qgs" / name).exists(), page
