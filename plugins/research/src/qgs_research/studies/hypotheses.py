"""Parser of hypotheses such as `A@noisy - A < B@noisy - B` into coefficients of means."""

import re
from collections import Counter
from collections.abc import Collection, Mapping
from typing import NamedTuple

from qgs.contracts import OptionError
from qgs.wording import did_you_mean

NAME = r"[A-Za-z0-9_][A-Za-z0-9_.]*"
"""Pattern of allowed names of variants and evaluations, which are used as folder names."""

MAIN = ""
"""Name of the default evaluation, whose options are those of the variants' recipes."""

_FORM = "write `A < B` or `A > B`; each side is a variant, or a sum such as `A@EVALUATION - A`"
_TERM = re.compile(rf"\s*([+-]?)\s*({NAME})(?:@({NAME}))?\s*")


class Contrast(NamedTuple):
    """Hypothesis as a weighted sum of mean scores: left side minus right side.

    terms: coefficient of each mean, by (variant, evaluation). sign: sign that the sum has if the
    hypothesis is true, 1 for `>` and -1 for `<`.
    """

    terms: Mapping[tuple[str, str], int]
    sign: int


def parsed(text: str, variants: Collection[str], evaluations: Collection[str]) -> Contrast:
    """Parse a hypothesis such as `A < B`.

    Raises OptionError for a text of another form, and for unknown variants or evaluations.
    """
    sides = re.split(r"\s*([<>])\s*", text.strip())
    if len(sides) != 3:
        raise OptionError(f"`{text}` needs exactly one `<` or `>`", _FORM)
    left, comparison, right = sides
    sums = Counter[tuple[str, str]]()
    for side, factor in ((left, 1), (right, -1)):
        matches = [*_TERM.finditer(side)]
        # A side has only terms, with a sign before each except the first.
        whole = "".join(match[0] for match in matches) == side and side
        if not whole or any(not match[1] for match in matches[1:]):
            raise OptionError(f"`{side}` in `{text}` is not a sum of variants", _FORM)
        for sign, variant, evaluation in (match.groups() for match in matches):
            _check_known("variant", variant, variants, text)
            if evaluation:
                _check_known("evaluation", evaluation, evaluations, text)
            sums[variant, evaluation or MAIN] += -factor if sign == "-" else factor
    # A sum that does not cancel would depend on the data set, not on the variants.
    if sums.total():
        raise OptionError(
            f"the sides of `{text}` have different sums, counting 1 per variant and -1 after a `-`",
            "write a variant on each side, or a difference, such as `A@noisy - A < B@noisy - B`",
        )
    terms = {term: coefficient for term, coefficient in sums.items() if coefficient}
    if not terms:
        raise OptionError(f"both sides of `{text}` are equal, so nothing is compared", _FORM)
    return Contrast(terms, -1 if comparison == "<" else 1)


def _check_known(noun: str, name: str, known: Collection[str], text: str) -> None:
    if name not in known:
        fix = did_you_mean(name, known, f"{noun}s")
        raise OptionError(f"`{text}` names the unknown {noun} `{name}`", fix)
