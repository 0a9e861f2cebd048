"""Every way of printing: control characters are escaped, those of Rich's own are not."""

import io
import logging
import re
import sys
from contextlib import redirect_stderr, redirect_stdout

import pytest
import rich.text
import typer
from rich.console import Console
from rich.progress import Progress

from qgs.cli import main
from qgs.terminal import shown

NAME = "a\x1b[2J\u202eb\x9bc\rd\x07"
CODES = r"\x1b\[[0-9;?]*[mKAlh]|\r"


@pytest.mark.parametrize("terminal", [False, True])
def test_every_way_of_printing(terminal, monkeypatch):
    monkeypatch.setattr(rich.text, "strip_control_codes", rich.text.strip_control_codes)
    monkeypatch.setattr(sys, "argv", ["qgs", "recipes", NAME])
    stream = io.StringIO()
    stream.isatty = lambda: terminal
    with redirect_stdout(stream) as out, redirect_stderr(out):
        with pytest.raises(SystemExit):
            main()
        print(1, NAME, file=sys.stderr)
        sys.stdout.writelines([NAME])
        typer.echo(NAME)
        logging.StreamHandler().emit(logging.makeLogRecord({"msg": NAME}))
        console = Console()
        console.print(NAME, style="bold")
        with Progress(console=console) as progress:
            progress.add_task(NAME, total=1)
            print(NAME)
    written = out.getvalue()
    assert bool(re.search(CODES, written)) == terminal
    left = re.sub(CODES, "", written).replace("\n", "")
    assert re.findall("[\0-\x1f\x7f-\x9f\u202e]", left) == []
    assert written.count(r"\u202e") >= 8


def test_what_is_shown():
    assert shown(NAME + "\n\té\udc80") == "a\\x1b[2J\\u202eb\\x9bc\\rd\\x07\n\té\\udc80"
