"""Files that name the scenes kept for testing."""

from __future__ import annotations

import json

from upath import UPath


def read_scene_list(file: UPath) -> list[str]:
    """Names of scenes in a file: the keys of a JSON mapping, such as an evaluation index, a JSON
    list of names, or lines of text, where what follows # is a comment.

    Raises FileNotFoundError, and ValueError for a file that names no scene.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise FileNotFoundError(f"the list of scenes {file} does not exist") from None
    if file.suffix == ".json":
        names = _from_json(file, text)
    else:
        lines = (line.partition("#")[0].strip() for line in text.splitlines())
        names = [line for line in lines if line]
    if not names:
        raise ValueError(f"the list of scenes {file} names no scene: write one on each line")
    return list(dict.fromkeys(names))


def _from_json(file: UPath, text: str) -> list[str]:
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{file} is not valid JSON ({error})") from error
    if not isinstance(data, dict | list) or not all(isinstance(name, str) for name in data):
        raise ValueError(
            f"{file} must be a mapping whose keys are scenes, or a list of scenes, in JSON"
        )
    return list(data)
