"""Write the tables of finished studies into docs/evidence.md, between its markers.

    python tools/fill_evidence.py FOLDER

FOLDER holds a folder of each study, as `qgs study ... --out FOLDER/NAME` left it. A region of the
page from `<!-- study: NAME -->` to `<!-- end -->` becomes the answer and the tables of table.md
there; where a study has several evaluations, their tables become one, of mean PSNR. A study without
a folder keeps what the page has, and a line says so.
"""

import argparse
import csv
import re
from pathlib import Path

from qgs.io.files import write_text

PAGE = Path(__file__).parents[1] / "docs" / "evidence.md"
REGION = re.compile(r"(<!-- study: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def table(text: str) -> str:
    """A table.md without padding in its cells, which would make long lines longer."""
    lines = [re.sub(r" *\| *", " | ", line).strip() for line in text.splitlines()]
    return "\n".join(re.sub(r"\|( :?)-+(:?) (?=\|)", r"|\1---\2 ", line) for line in lines) + "\n"


def by_evaluation(file: Path) -> str:
    """Mean PSNR and its standard deviation over seeds, of every variant in every evaluation."""
    with file.open(encoding="utf-8") as lines:
        rows = [row for row in csv.DictReader(lines) if row["metric"] == "psnr"]
    cells: dict[str, dict[str, str]] = {}
    for row in rows:
        mean = f"{float(row['mean']):.2f} ({float(row['sd']):.2f})"
        cells.setdefault(row["evaluation"], {})[row["variant"]] = mean
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    heading = f"| PSNR (sd) | {' | '.join(variants)} |\n|---|{'--:|' * len(variants)}\n"
    of_all = {name: found for name, found in cells.items() if name}
    return heading + "".join(
        f"| {name} | {' | '.join(found.get(v, '') for v in variants)} |\n"
        for name, found in of_all.items()
    )


def page_of(study: Path) -> str:
    """What the page shows of a finished study."""
    text = (study / "table.md").read_text(encoding="utf-8")
    if single := re.search(r"^\*\*\w+\*\*$", text, re.MULTILINE):
        notes = text[text.rindex("\n\n- ") + 1 :]
        text = text[: single.start()] + by_evaluation(study / "table.csv") + notes
    return table(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("folder", type=Path)
    studies: Path = parser.parse_args().folder

    def filled(region: re.Match[str]) -> str:
        study = studies / region[2]
        if not (study / "table.md").exists():
            print(f"{study} has no table.md: the page keeps what it has of {region[2]}")
            return region[0]
        return f"{region[1]}\n{page_of(study)}\n{region[3]}"

    write_text(PAGE, REGION.sub(filled, PAGE.read_text(encoding="utf-8")))


if __name__ == "__main__":
    main()
