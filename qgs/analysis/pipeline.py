"""A small picture of a model: from views over queries and decoder layers to Gaussians."""

from collections.abc import Mapping, Sequence
from html import escape

LETTER, LINE, PAD, GAP = 6.7, 16, 8, 34
"""Pixels: a letter's width, a line's height, space within a box and between two."""
FONT = "font:11px ui-monospace,monospace"
Box = tuple[str, Sequence[str]]  # heading, lines


def pipeline_svg(
    kinds: Mapping[str, str], counts: Mapping[str, int], depth: int, gaussians: str
) -> str:
    """Boxes and arrows in the colour of the text around; counts are numbers of parameters.

    kinds, counts: by slot, those of decoder layers as "decoder.SLOT". gaussians: what is made.
    """

    def box(heading: str, *slots: str) -> Box:
        """Of slots that are not the heading, the name too."""
        named = {slot: f"{slot.split('.')[-1]}: " * (slot != heading) for slot in slots}
        lines = [f"{name}{kinds[slot]}" for slot, name in named.items() if kinds.get(slot)]
        return heading, [*lines, f"{sum(counts[slot] for slot in slots):,} parameters"]

    inside = [slot for slot in counts if slot.startswith("decoder.")]
    columns = [
        [("views", ["photos", "cameras"])],
        [box("encoder", "encoder"), box("queries", "queries")],
        [box(f"{depth} decoder layers", *inside)],
        [box("head", "head", "centers")],
        [("Gaussians", [gaussians] if gaussians else [])],
    ]
    height = max(sum(_height(each) + PAD for each in column) for column in columns) + PAD
    left, parts, before = 1.0, list[str](), list[tuple[float, float]]()
    for column in columns:
        wide = max(len(line) for heading, lines in column for line in (heading, *lines))
        wide = wide * LETTER + 2 * PAD
        top = (height - sum(_height(each) + PAD for each in column) + PAD) / 2
        after = []
        for each in column:
            parts.append(_drawn(each, left, top, wide))
            middle = top + _height(each) / 2
            if each[0] != "queries":  # they are learned, and read photos in the decoder
                parts += [_arrow(x, y, left, middle) for x, y in before]
            after.append((left + wide, middle))
            top += _height(each) + PAD
        left, before = left + wide + GAP, after
    width = left - GAP + 2
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" style="max-width:100%;{FONT}" fill="currentColor" role="img" '
        f'aria-label="from views to Gaussians">{"".join(parts)}</svg>'
    )


def _height(box: Box) -> float:
    return (1 + len(box[1])) * LINE + PAD


def _drawn(box: Box, left: float, top: float, wide: float) -> str:
    rim = (
        f'<rect x="{left:.0f}" y="{top:.0f}" width="{wide:.0f}" height="{_height(box):.0f}" rx="4"'
    )
    texts = [
        f'<text x="{left + PAD:.0f}" y="{top + LINE * (row + 1):.0f}" '
        f'font-weight="{400 if row else 700}">{escape(line)}</text>'
        for row, line in enumerate((box[0], *box[1]))
    ]
    return f'{rim} fill="none" stroke="currentColor"/>{"".join(texts)}'


def _arrow(x: float, y: float, to_x: float, to_y: float) -> str:
    bend, tip = x + GAP / 2, f"M{to_x:.0f} {to_y:.0f}l-7 -4v8z"
    way = f"M{x:.0f} {y:.0f}C{bend:.0f} {y:.0f} {bend:.0f} {to_y:.0f} {to_x - 6:.0f} {to_y:.0f}"
    return f'<path d="{way}" fill="none" stroke="currentColor"/><path d="{tip}"/>'
