"""Tensors to pictures and figures; pages that need no other file."""

from collections.abc import Callable

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined


def page_environment(*packages: str, **filters: Callable[..., str]) -> Environment:
    """Jinja for pages whose templates are in `packages`, or else in qgs.drawing."""
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(p, "template") for p in (*packages, "qgs.drawing")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters)
    return environment
