"""pydantic's errors as reasons and fixes in a recipe's terms."""

from __future__ import annotations

from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from qgs.composer.nodes import ListNode, MapNode, Node, kind_of
from qgs.composer.suggest import did_you_mean, nearest
from qgs.contracts import OptionError

_BOUNDS = {
    "greater_than": ("gt", "more than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}
_LENGTHS = {"too_short": ("min_length", "at least"), "too_long": ("max_length", "at most")}
_KINDS = {
    "int_type": "an integer",
    "int_from_float": "an integer",
    "float_type": "a number",
    "bool_type": "true or false",
    "string_type": "a string",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
}
_BOOL_WORDS = {
    **dict.fromkeys(("on", "yes", "y"), "true"),
    **dict.fromkeys(("off", "no", "n"), "false"),
}


def place_of(error: ErrorDetails, node: Node) -> tuple[str | int, ...]:
    """The steps from a component to the option that `error` is about, as written in `node`."""
    steps: list[str | int] = []
    for position, step in enumerate(error["loc"]):
        last = position == len(error["loc"]) - 1
        if isinstance(node, MapNode) and str(step) in node.items:
            node = node.items[str(step)]
        elif isinstance(node, ListNode) and isinstance(step, int) and step < len(node.items):
            node = node.items[step]
        elif not (last and error["type"] == "missing" and isinstance(step, str)):
            continue
        steps.append(step)
    return tuple(steps)


def explain(error: ErrorDetails, given: Node | None, config: type[BaseModel]) -> tuple[str, str]:
    """Reason and fix. given: the offending value; config: the class that refused it."""
    kind, context = error["type"], error.get("ctx", {})
    option = str(error["loc"][-1]) if error["loc"] else ""
    default = _default(config, error)
    what = kind_of(given) if given is not None else "nothing"
    if kind == "extra_forbidden":
        siblings = _options_beside(config, error["loc"])
        return f"there is no option `{option}`", did_you_mean(option, siblings, "options")
    if kind == "missing" and isinstance(given, ListNode):
        count = _items_expected(config, error["loc"])
        return f"needs {count} items, got {len(given.items)}", f"give {count} items{default}"
    if kind == "missing":
        return f"the option `{option}` is missing and has no default", f"add `{option}: ...`"
    if kind in _BOUNDS:
        name, words = _BOUNDS[kind]
        bound = f"{words} {context[name]:g}"
        return f"must be {bound}, got {what}", f"give a number of {bound}{default}"
    if kind in _LENGTHS:
        name, words = _LENGTHS[kind]
        length = f"{words} {context[name]} items"
        return f"must have {length}, got {context['actual_length']}", f"give {length}{default}"
    if kind in _KINDS:
        return f"must be {_KINDS[kind]}, got {what}", _kind_fix(kind, given, default)
    if kind == "literal_error":
        expected = context["expected"]
        return f"must be {expected}, got {what}", _literal_fix(given, expected, default)
    if kind == "finite_number":
        return f"must be a finite number, got {what}", f"give a finite number{default}"
    if kind == "value_error" and isinstance(context["error"], OptionError):
        return context["error"].reason, f"{context['error'].fix}{default}"
    if kind == "value_error":
        return str(context["error"]), f"change the value so that this holds{default}"
    message = error["msg"][:1].lower() + error["msg"][1:]
    return f"{message}, got {what}", f"give a value that fits{default}"


def _kind_fix(kind: str, given: Node | None, default: str) -> str:
    value = getattr(given, "value", None)
    if kind == "bool_type" and isinstance(value, str) and value.lower() in _BOOL_WORDS:
        word = _BOOL_WORDS[value.lower()]
        return f"write `{word}`: in YAML 1.2 `{value}` is a string"
    if kind == "string_type":
        return f"put it in quotes{default}"
    return f"give {_KINDS[kind]}{default}"


def _literal_fix(given: Node | None, expected: str, default: str) -> str:
    near = nearest(str(getattr(given, "value", "")), [word.strip("'") for word in _words(expected)])
    return f"did you mean `{near}`?" if near else f"choose {expected}{default}"


def _words(expected: str) -> list[str]:
    return expected.replace(" or ", ", ").split(", ")


def _default(config: type[BaseModel], error: ErrorDetails) -> str:
    """A note on the default of the top-level option that `error` is in."""
    field = config.model_fields.get(str(error["loc"][0])) if error["loc"] else None
    if field is None or field.is_required() or isinstance(field.default, BaseModel):
        return ""
    value = field.get_default()
    shown = list(value) if isinstance(value, tuple) else value
    return f" (default: {_yaml_word(shown)})"


def _yaml_word(value: object) -> str:
    words = {"True": "true", "False": "false", "None": "null"}
    return words.get(str(value), str(value))


def _options_beside(config: type[BaseModel], loc: tuple[str | int, ...]) -> set[str]:
    """Options of the (nested) config that the last step of `loc` was looked for in."""
    return {name for model in _models_at(config, loc[:-1]) for name in model.model_fields}


def _models_at(config: type[BaseModel], loc: tuple[str | int, ...]) -> set[type[BaseModel]]:
    """The (nested) configs that `loc` leads to; the tag of a union chooses among its members."""
    models = {config}
    for step in loc:
        fields = [m.model_fields[str(step)] for m in models if str(step) in m.model_fields]
        if fields:
            models = {model for field in fields for model in models_in(field.annotation)}
        else:
            models = {model for model in models if _is_tagged(model, step)} or models
    return models


def _is_tagged(model: type[BaseModel], tag: str | int) -> bool:
    return any(tag in get_args(field.annotation) for field in model.model_fields.values())


def _items_expected(config: type[BaseModel], loc: tuple[str | int, ...]) -> int:
    """Length of the tuple that the last step of `loc` counts in."""
    name = str(next(step for step in reversed(loc) if isinstance(step, str)))
    depth = loc.index(name)
    models = _models_at(config, loc[:depth])
    annotations = [m.model_fields[name].annotation for m in models if name in m.model_fields]
    return max(len(get_args(annotation)) for annotation in annotations)


def models_in(annotation: Any) -> set[type[BaseModel]]:
    """The (nested) configs that an option of this type can hold."""
    if get_origin(annotation) is None:
        is_model = isinstance(annotation, type) and issubclass(annotation, BaseModel)
        return {annotation} if is_model else set()
    return {model for part in get_args(annotation) for model in models_in(part)}
