"""Write the tables of finished studies into docs/evidence.md, between its markers.

    python tools/fill_evidence.py FOLDER

FOLDER holds a folder of each study, as `qgs study ... --out FOLDER/NAME` left it. A region of the
page from `<!-- study: NAME -->` to `<!-- end -->` becomes the answer and the tables of table.md
there. A study without a folder keeps what the page has, and a line says so.
"""

import argparse
import re
from pathlib import Path

from qgs.io.files import write_text

PAGE = Path(__file__).parents[1] / "docs" / "evidence.md"
REGION = re.compile(r"(<!-- study: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def table(text: str) -> str:
    """A table.md without padding in its cells, which would make long lines longer."""
    lines = [re.sub(r" *\| *", " | ", line).strip() for line in text.splitlines()]
    return "\n".join(re.sub(r"\|( :?)-+(:?) (?=\|)", r"|\1---\2 ", line) for line in lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("folder", type=Path)
    studies: Path = parser.parse_args().folder

    def filled(region: re.Match[str]) -> str:
        path = studies / region[2] / "table.md"
        if not path.exists():
            print(f"{path} does not exist: the page keeps what it has of {region[2]}")
            return region[0]
        return f"{region[1]}\n{table(path.read_text(encoding='utf-8'))}\n{region[3]}"

    write_text(PAGE, REGION.sub(filled, PAGE.read_text(encoding="utf-8")))


if __name__ == "__main__":
    main()
