"""A small picture of a model: from views over queries and decoder layers to Gaussians."""

from collections.abc import Mapping
from html import escape

LETTER, LINE, PAD, GAP = 6.7, 16, 8, 34
"""Pixels: a letter's width, a line's height, space around text, the length of arrows."""


def pipeline_svg(
    kinds: Mapping[str, str], counts: Mapping[str, int], depth: int, learned: bool
) -> str:
    """Boxes and arrows in the colour of the text around.

    kinds, counts: by slot, those of decoder layers as "decoder.SLOT": components, parameters.
    learned: whether queries start from parameters alone, and only the decoder reads photos.
    """

    def told(*slots: str) -> list[str]:
        lines = [f"{slot.split('.')[-1]}: {kinds[slot]}" for slot in slots if kinds[slot]]
        return [*lines, f"{sum(counts[slot] for slot in slots):,} parameters"]

    inside = [slot for slot in counts if slot.startswith("decoder.")]
    columns = [  # of boxes, of lines
        [["views", "photos", "cameras"]],
        [told("encoder"), told("queries")],
        [[f"{depth} decoder layers", *told(*inside)]],
        [told("head", "centers")],
        [["Gaussians"]],
    ]
    lows = [sum(len(box) * LINE + 6 + PAD for box in column) + PAD for column in columns]
    high = max(lows)
    left, parts, ends = 1.0, list[str](), list[float]()
    for column, low in zip(columns, lows, strict=True):
        wide = max(len(line) for box in column for line in box) * LETTER + 2 * PAD
        gap, end, middles = PAD + (high - low) / (len(column) + 1), 0.0, list[float]()
        for box in column:
            half = len(box) * LINE / 2 + 3
            middle, end = end + gap + half, end + gap + 2 * half
            middles.append(middle)
            size = f'width="{wide:.0f}" height="{2 * half:.0f}" rx="4" fill="none"'
            parts.append(f'<rect x="{left:.0f}" y="{middle - half:.0f}" {size}/>')
            for number, line in enumerate(box):
                place = f'x="{left + PAD:.0f}" y="{middle - half + LINE * (number + 1) - 1:.0f}"'
                parts.append(f'<text {place} stroke="none">{escape(line)}</text>')
            if not (learned and box[0].startswith("queries")):
                way = f"{left - GAP / 2:.0f} {middle:.0f} {left - 6:.0f} {middle:.0f}h6l-7-4v8l7-4"
                parts += [f'<path d="M{left - GAP:.0f} {y:.0f}S{way}" fill="none"/>' for y in ends]
        left, ends = left + wide + GAP, middles
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {left - GAP + 2:.0f} {high:.0f}" '
        f'width="{left - GAP + 2:.0f}" fill="currentColor" stroke="currentColor" '
        f'style="max-width:100%;font:11px ui-monospace,monospace">{"".join(parts)}</svg>'
    )
