"""An extension of griffe, which reads the code for mkdocstrings: docstrings with lists."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from griffe import Extension  # pyright: ignore[reportMissingImports]

sys.path.insert(0, str(Path(__file__).parent))

from guide_docstrings import with_lists


class Lists(Extension):
    """Explanations of parameters and fields become lists."""

    def on_function_instance(self, *, func: Any, **others: Any) -> None:
        """A function: its parameters are what may be explained."""
        if func.docstring:
            names = [parameter.name for parameter in func.parameters]
            func.docstring.value = with_lists(func.docstring.value, names)

    def on_class_members(self, *, cls: Any, **others: Any) -> None:
        """A class: its fields are, and what its constructor takes."""
        if cls.docstring:
            made_by = cls.members.get("__init__")
            given = [p.name for p in made_by.parameters] if made_by else []
            cls.docstring.value = with_lists(cls.docstring.value, [*cls.members, *given])
