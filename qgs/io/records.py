"""Files of JSON records, one a line, that grow while a program runs."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)


def read_records(path: Path) -> list[dict[str, Any]]:
    """The records of `path` that tell their "step"; none when the file does not exist.

    A line that is no such record is left out with a warning; a last line without an end is what a
    killed process leaves, and is left out too.
    """
    if not path.is_file():
        return []
    *lines, _ = path.read_text(encoding="utf-8", errors="replace").split("\n")
    records = []
    for number, line in enumerate(lines, start=1):
        record = _parsed(line)
        if record is None:
            _log.warning("%s, line %d is damaged and left out: %.80r", path, number, line)
        else:
            records.append(record)
    return records


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except ValueError:
        return None
    return record if isinstance(record, dict) and isinstance(record.get("step"), int) else None
