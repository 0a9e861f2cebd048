"""Terminal output without control characters and passwords; printing of tables and lines."""

import re
import sys
from collections.abc import Iterable, Sequence
from typing import Any, TextIO

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

_RAW = "[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
# A password may hold / ? #.
_USER = r"(?<=://)(?:[^\s/?#@:]{0,99}:\S{0,300}|[^\s/?#]{0,300})@"
_TOKEN = (
    r"(?i)([?&#][^\s=&?#]{0,40}(?:token|key|sig|secret|pass|auth|cred)[^\s=&?#]{0,40}=)[^\s&#]+"
)


def without_secrets(text: str) -> str:
    """Return `text` with *** in place of users, passwords, tokens and signatures in URLs."""
    return re.sub(_TOKEN, r"\1***", re.sub(_USER, "***@", text))


def shown(text: str) -> str:
    r"""Return `text` without secrets and with control characters escaped, such as \x1b, \u202e."""
    return re.sub(_RAW, lambda found: ascii(found[0])[1:-1], without_secrets(text))


class _Shown:
    """Text stream that passes all text through `shown` before it is written.

    rich_proxied_file: the original stream, to which Rich writes its own control codes.
    """

    def __init__(self, stream: TextIO) -> None:
        self.rich_proxied_file = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)

    def write(self, text: str) -> int:
        # While Rich draws, a proxy of its own stands in for us, and Rich alone writes here.
        raw = self not in (sys.stdout, sys.stderr)
        self.rich_proxied_file.write(text if raw else shown(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        self.write("".join(lines))


def show_safely() -> None:
    """Pass everything that this process prints from now on through `shown`; keep Rich's colours."""
    import rich.text

    # Rich calls this on all text that it draws.
    rich.text.__dict__["strip_control_codes"] = shown
    for name in ("stdout", "stderr"):
        # A process without a terminal may have None here.
        if stream := getattr(sys, name):
            setattr(sys, name, _Shown(stream))


def print_table(
    console: Console, title: str, rows: Sequence[Sequence[str | Text]], **options: Any
) -> None:
    """Print a table whose first column aligns left and whose other columns align right.

    rows: the headers, then the cells of each row; brackets in a `str` are printed as they are.
    options: arguments of Rich's `Table`.
    """
    table = Table(title=escape(title) or None, title_justify="left", **options)
    for place, header in enumerate(rows[0]):
        table.add_column(header, justify="right" if place else "left", overflow="fold")
    for row in rows[1:]:
        table.add_row(*row)
    console.print(table, markup=False)


def print_lines(console: Console, lines: Iterable[str]) -> None:
    """Print lines of plain text."""
    for line in lines:
        console.print(escape(line), highlight=False, soft_wrap=True, emoji=False)
