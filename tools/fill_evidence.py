"""Write the tables of finished studies into the pages of docs/, between their markers.

    python tools/fill_evidence.py FOLDER

FOLDER holds a folder of each study, as `qgs study ... --out FOLDER/NAME` left it. A region of a
page from `<!-- study: NAME -->` to `<!-- end -->` becomes the answer and the tables of table.md
there; where a study has several evaluations, their tables become one, of mean PSNR. Figures go to
docs/images/evidence_NAME.webp: the study's, or lines over evaluations that are called WHAT_NUMBER.
A study without a folder keeps what the page has, and a line says so.
"""

import argparse
import json
import math
import re
from io import BytesIO
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

from qgs.drawing.figures import categorical, figure_style, hex_color
from qgs.files import replacing, write_text

DOCS = Path(__file__).parents[1] / "docs"
UNITS = {"noise": "degrees of noise", "views": "input views"}
REGION = re.compile(r"(<!-- study: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


REPEATED = re.compile(
    r" \(the interval holds 0\)|^- (?:intervals: 95 %|each of \d+ verdicts).*\n?", re.M
)
"""What the page says once, in "How it was measured"."""


def table(text: str) -> str:
    """A table.md without padding in its cells and without what the page says once."""
    lines, skipped = [], None
    for line in REPEATED.sub("", text).splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if "verdict" in cells:  # a table of hypotheses, all of the same seeds and scenes
            skipped = cells.index("of")
        elif len(cells) == 1:
            skipped = None
        if skipped is not None:
            del cells[skipped]
        lines.append(" | ".join(cells).strip())
    return "\n".join(re.sub(r"\|( :?)-+(:?) (?=\|)", r"|\1---\2 ", line) for line in lines) + "\n"


def means(study: Path) -> dict[str, dict[str, tuple[float, float]]]:
    """PSNR, mean and standard deviation over seeds (nan of one), by evaluation and variant."""
    found: dict[str, dict[str, tuple[float, float]]] = {}
    record = json.loads((study / "results.json").read_text(encoding="utf-8"))
    for row in record["table"]:
        if row["metric"] == "psnr" and row["evaluation"]:
            of_all = found.setdefault(row["evaluation"], {})
            of_all[row["variant"]] = row["mean"], row["sd"] or math.nan
    return found


def by_evaluation(study: Path) -> str:
    """Mean PSNR and its standard deviation over seeds, of every variant in every evaluation."""
    found = means(study)
    variants = list(next(iter(found.values())))
    lines = [f"| PSNR (sd) | {' | '.join(variants)} |", f"|---|{'--:|' * len(variants)}"]
    for name, of_all in found.items():
        cells = (f"{of_all[v][0]:.2f} ({of_all[v][1]:.2f})".replace("nan", "–") for v in variants)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw_lines(study: Path) -> Figure | None:
    """A panel for each WHAT of evaluations named WHAT_NUMBER: PSNR over the numbers; or None."""
    found, panels = means(study), dict[str, list[str]]()
    for name in found:
        if match := re.fullmatch(r"(\w+)_(\d+)", name):
            panels.setdefault(match[1], []).append(name)
    if "exact" in found and "noise" in panels:
        found["noise_0"] = found["exact"]
        panels["noise"].insert(0, "noise_0")
    if not panels:
        return None
    with figure_style():
        figure = Figure(figsize=(7.6, 2.9), layout="constrained")
        row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (what, names) in zip(row, panels.items(), strict=True):
            at = [int(name.rpartition("_")[2]) for name in names]
            for place, variant in enumerate(found[names[0]]):
                values, spread = zip(*(found[name][variant] for name in names), strict=True)
                look = {"color": hex_color(categorical(place)), "marker": "o", "markersize": 3}
                axes.errorbar(at, values, spread, label=variant, **look)
            axes.set(xlabel=f"{UNITS.get(what, what)} in the test", xticks=at)
        figure.axes[0].set(title="PSNR, dB; bars: sd over seeds")
        figure.axes[0].legend(loc="center left")
    return figure


def write_figure(study: Path, file: Path) -> None:
    """The study's figure as a picture for the page."""
    pixels: BytesIO | Path = study / "figures" / "values.png"
    quality = {}
    if figure := draw_lines(study):
        pixels, quality = BytesIO(), {"quality": 88}
        figure.savefig(pixels, format="png", dpi=160)
    with replacing(file) as path:
        Image.open(pixels).convert("RGB").save(path, "WEBP", **quality)


def page_of(study: Path) -> str:
    """What the page shows of a finished study."""
    text = (study / "table.md").read_text(encoding="utf-8")
    if single := re.search(r"^\*\*\w+\*\*$", text, re.MULTILINE):
        notes = re.search(r"\n\n- .*\Z", text, re.DOTALL)  # there may be none
        text = text[: single.start()] + by_evaluation(study) + (notes[0][1:] if notes else "")
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
        image = DOCS / "images" / f"evidence_{region[2]}.webp"
        write_figure(study, image)
        shown = f"![{region[2]}: the figures of the table below](images/{image.name})"
        return f"{region[1]}\n{shown}\n\n{page_of(study)}\n{region[3]}"

    for page in DOCS.glob("*.md"):
        text = page.read_text(encoding="utf-8")
        if REGION.search(text):
            write_text(page, REGION.sub(filled, text))


if __name__ == "__main__":
    main()
