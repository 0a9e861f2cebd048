"""YAML 1.2 core scalars (yaml.org/spec/1.2.2, section 10.3) for PyYAML, which speaks YAML 1.1."""

from __future__ import annotations

import re
from typing import Any

import yaml

_RESOLVERS = (
    ("null", r"~|null|Null|NULL|", "~nN\0"),
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"
        r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
)


MAX_NESTING = 64
_LARGEST = 2**63 - 1


class NestingError(yaml.MarkedYAMLError):
    """Mappings and lists inside each other, beyond what any recipe needs."""


class Yaml12Loader(yaml.SafeLoader):
    """Composes nodes with YAML 1.2 tags; `qgs.composer.loader` reads their values."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012
    _nesting = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """PyYAML's, refusing what would overflow the stack of whoever walks the tree."""
        self._nesting += 1
        if self._nesting > MAX_NESTING:
            raise NestingError(
                problem=f"mappings and lists stand more than {MAX_NESTING} deep in each other",
                problem_mark=self.peek_event().start_mark,
            )
        node = super().compose_node(parent, index)
        self._nesting -= 1
        return node


class Yaml12Dumper(yaml.SafeDumper):
    """Quotes exactly the strings that Yaml12Loader would not read as strings."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        """Write repeated values out."""
        return True


for _kind, _pattern, _first in _RESOLVERS:
    for _class in (Yaml12Loader, Yaml12Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_kind}",
            re.compile(f"^(?:{_pattern})$"),
            [c if c != "\0" else "" for c in _first],
        )


def scalar_value(tag: str, text: str) -> Any:
    """The value of a scalar of a resolved `tag`; raises ValueError for a text that has none.

    Raises OverflowError for an integer beyond 64 bits.
    """
    kind = tag.removeprefix("tag:yaml.org,2002:")
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() == "true"
    if kind == "int":
        base = {"0o": 8, "0x": 16}.get(text[:2], 10)
        if len(text) > 100 or abs(value := int(text, base)) > _LARGEST:
            raise OverflowError(f"an integer of {len(text)} digits does not fit into 64 bits")
        return value
    if kind == "float":
        return float(re.sub(r"\.(inf|nan)$", r"\1", text, flags=re.IGNORECASE))
    return text


def dump(value: Any, *, flow: bool | None = False) -> str:
    """`value` as YAML 1.2, keys in their order."""
    return yaml.dump(
        value, Dumper=Yaml12Dumper, sort_keys=False, default_flow_style=flow, width=10_000
    )
