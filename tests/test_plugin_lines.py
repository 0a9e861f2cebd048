"""What a plugin writes only because there is a framework is little, and counted right."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from plugin_lines import counted

SOURCE = '''
"""A file."""

import torch

NAME = "a.name"
FIELD: Fields = {
    NAME: 1,
}


class Mine(Refinement):
    """A component."""

    name: ClassVar[str] = "mine"

    class Config(ComponentConfig):
        """Options."""

        size: int = 1

    config: Config

    def __init__(self, config, dims):
        super().__init__(config, dims)
        self.layer = 1  # a comment

    @classmethod
    def requires(cls, config):
        """Docs."""
        return FIELD

    @classmethod
    def problems(cls, config, context):
        yield 1

    def forward(self, state):
        total = (
            state
            + 1
        )
        return total
'''


def test_lines_are_counted_by_purpose(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(SOURCE)
    assert counted(path) == Counter(imports=1, state=4, declarations=9, options=4, mathematics=7)


def test_registration_and_declarations_of_the_ellipsoid_plugin_are_under_60_lines() -> None:
    source = Path(__file__).parents[1] / "plugins" / "ellipsoid" / "src"
    lines = sum((counted(path) for path in source.rglob("*.py")), Counter())
    assert lines["mathematics"] > 100
    assert 0 < lines["registration"] + lines["declarations"] < 60
