"""The guide's pages on the contract suite list all of it; docstrings become lists."""

from __future__ import annotations

import re

import guide_checks
from guide_docstrings import with_lists

import qgs.testing
from qgs.testing import CHECKS


def test_every_public_name_of_the_suite_is_documented() -> None:
    page = guide_checks.testing_page()
    documented = {name.rpartition(".")[2] for name in re.findall(r"^::: (.*)$", page, re.MULTILINE)}
    headings = set(re.findall(r"^## (\w+)$", page, re.MULTILINE))
    assert documented | headings == set(qgs.testing.__all__)


def test_every_check_is_listed_with_its_contract() -> None:
    for page in (guide_checks.testing_page(), guide_checks.check_list()):
        for check in CHECKS.values():
            (row,) = [row for row in page.splitlines() if row.startswith(f"| `{check.name}` |")]
            assert row.endswith(f"| {check.contract} |")
            assert len(check.contract) > 20, "a contract is a sentence"


def test_explanations_of_parameters_become_a_list() -> None:
    text = """Join things.

first, second: what to join, which may be
    long. glue: between them; None for none.
It takes a while. Raises ValueError without things.

    join(1, 2)
"""
    assert (
        with_lists(text, ["first", "second", "glue"])
        == """Join things.

- `first`, `second`: what to join, which may be long.
- `glue`: between them; None for none.

It takes a while.

Raises ValueError without things.

    join(1, 2)
"""
    )


def test_text_that_explains_nothing_stays_as_it_is() -> None:
    text = "Note: this is prose.\n\nother: is no parameter. name: is behind no beginning."
    assert with_lists(text, ["name"]) == text
    assert with_lists(text, []) == text
