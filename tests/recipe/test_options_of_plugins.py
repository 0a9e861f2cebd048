"""Options of plugins that cannot work, or have no effect, are refused: refused.txt of their tests.

The first line is a recipe. Of each override below it the next line says `option: reason`.
"""

import yaml
from refusals import refused
from size import ROOT

FILES = [*ROOT.glob("plugins/*/tests/**/refused.txt")]


def test_overrides_are_refused():
    for file in FILES:
        recipe, *lines = file.read_text().splitlines()
        for override, expected in zip(lines[::2], lines[1::2], strict=True):
            option, _, reason = expected.strip().partition(":")
            problem = refused(yaml.safe_load(recipe), [override])
            assert problem.option == option, (file, override)
            assert reason.strip() in problem.reason, (file, override)
    assert FILES
