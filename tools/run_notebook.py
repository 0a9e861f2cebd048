"""Runs the code cells of a notebook top to bottom in one namespace and stores what they show.

    python tools/run_notebook.py docs/tour.ipynb

It needs neither IPython nor a kernel: of a cell's last expression it keeps what a notebook would
show, `_repr_html_` or `_repr_png_` and the text. A cell that raises ends it, and nothing is stored.
"""

import ast
import base64
import json
import re
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from qgs.files import write_text

ROOT = Path(__file__).resolve().parents[1]


def run(notebook: dict[str, Any]) -> dict[str, Any]:
    """Run the cells of `notebook`, as JSON, and put their outputs in; returns their names."""
    names: dict[str, Any] = {"__name__": "__main__"}
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(code, start=1):
        tree = ast.parse("".join(cell["source"]), f"cell {number}")
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        printed = StringIO()
        with redirect_stdout(printed), redirect_stderr(printed):
            exec(compile(tree, f"cell {number}", "exec"), names)
            value = None
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names)
        cell["execution_count"], cell["outputs"] = number, []
        if text := printed.getvalue().replace(f"{ROOT}/", ""):
            cell["outputs"].append({"output_type": "stream", "name": "stdout", "text": lines(text)})
        if value is not None:
            shown = {"output_type": "execute_result", "execution_count": number, "metadata": {}}
            cell["outputs"].append({**shown, "data": mimes(value)})
    return names


def mimes(value: Any) -> dict[str, Any]:
    """What a notebook shows of `value`, by type."""
    data: dict[str, Any] = {"text/plain": lines(re.sub(" at 0x[0-9A-F]+", "", repr(value)))}
    html = value._repr_html_() if hasattr(value, "_repr_html_") else None
    png = value._repr_png_() if hasattr(value, "_repr_png_") else None
    if html:
        data["text/html"] = lines(html)
    if png:
        data["image/png"] = base64.b64encode(png).decode()
    return data


def lines(text: str) -> list[str]:
    """As notebooks store text."""
    return text.splitlines(keepends=True)


if __name__ == "__main__":
    file = Path(sys.argv[1])
    notebook = json.loads(file.read_text(encoding="utf-8"))
    run(notebook)
    write_text(file, json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")
