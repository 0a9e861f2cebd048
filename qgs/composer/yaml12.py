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


class Yaml12Loader(yaml.SafeLoader):
    """Composes nodes with YAML 1.2 tags; `qgs.composer.loader` reads their values."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012


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
    """The value of a scalar of a resolved `tag`; raises ValueError for a text that has none."""
    kind = tag.removeprefix("tag:yaml.org,2002:")
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() == "true"
    if kind == "int":
        return int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))
    if kind == "float":
        return float(re.sub(r"\.(inf|nan)$", r"\1", text, flags=re.IGNORECASE))
    return text


def dump(value: Any, *, flow: bool | None = False) -> str:
    """`value` as YAML 1.2, keys in their order."""
    return yaml.dump(
        value, Dumper=Yaml12Dumper, sort_keys=False, default_flow_style=flow, width=10_000
    )
