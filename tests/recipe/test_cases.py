"""Recipes of cases/: what is refused, each mistake at its place, and what others resolve to.

A case is its title, recipe.yaml, and other files, each below its name; `--set` has an override a
line. `# refused: OPTION: WORDS` stands in the line that is blamed, `# warns: WORDS` anywhere; words
are parted by `;`. `resolved` has lines of the resolved recipe, and after `no` what begins none.
`plugin NAME` is the module of a distribution, which stays installed in later cases of a file.
"""

import re
from pathlib import Path

import pytest
from refusals import problems_of

from qgs.recipe import resolve
from qgs.recipe.recipe import annotated, flat
from qgs.recipe.yaml_text import inline

CASES = Path(__file__).parent / "cases"
SMALL = """
recipe: 1
plugins: [mine, tokengs2026]
model: {width: 16, heads: 2, decoder: {depth: 2}, supervision: {layers: [2]}}
"""
REFUSED = re.compile(r" *# refused: (\S+): (.+)")


def split(text, mark):
    """Headings, marked at the start of their lines, and the text below each."""
    found = re.split(f"^{mark} (.+)\n", text, flags=re.MULTILINE)
    return list(zip(found[1::2], found[2::2], strict=True))


def has_all(text, words):
    return all(word in text for word in words.split("; "))


def faults(files):
    """Return all that is not as the case says."""
    overrides = [REFUSED.sub("", line) for line in files.get("--set", "").splitlines() if line]
    expected = [
        (f"{name} #{number}" if name == "--set" else f"{name}:{number}", *found.groups())
        for name, text in sorted(files.items())
        for number, line in enumerate(text.splitlines(), start=1)
        if (found := REFUSED.search(line))
    ]
    problems = problems_of("recipe.yaml", overrides)
    if expected or problems:
        told = [str(problem) for problem in problems]
        same = len(told) == len(expected) and all(
            str(problem).startswith(f"{place}: {option}\n")
            and has_all(f"{problem.reason}; {problem.fix}", words)
            for problem, (place, option, words) in zip(problems, expected, strict=True)
        )
        return [] if same else told or ["accepted"]
    recipe = resolve("recipe.yaml", overrides)
    Path("again.yaml").write_text(annotated(recipe))
    wrong = [] if resolve("again.yaml").tree == recipe.tree else ["another recipe when read again"]
    warned = re.findall("# warns: (.+)", files["recipe.yaml"])
    if len(warned) != len(recipe.warnings) or not all(map(has_all, recipe.warnings, warned)):
        wrong += recipe.warnings or ["no warning"]
    origins = recipe.provenance
    shown = [f"{path}: {inline(x)}  # {origins[path]}" for path, x in flat(recipe.tree).items()]
    for line in files.get("resolved", "").splitlines():
        absent = line.removeprefix("no ")
        there = line in shown if line == absent else not any(x.startswith(absent) for x in shown)
        wrong += [] if there or not line else [line]
    return wrong


@pytest.mark.parametrize("subject", sorted(file.stem for file in CASES.iterdir()))
def test_recipes_are_refused_or_resolved(subject, installed, install, tmp_path, monkeypatch):
    wrong = []
    cases = split((CASES / f"{subject}.txt").read_text(), "===")
    for number, (title, text) in enumerate(cases):
        folder = tmp_path / str(number)
        folder.mkdir()
        monkeypatch.chdir(folder)
        headed = split(f"--- recipe.yaml\n{text}", "---")
        files = dict(headed)
        assert len(files) == len(headed), title
        for name, content in {"small.yaml": SMALL, **files}.items():
            kind, _, plugin = name.partition(" ")
            assert kind in ("--set", "resolved", "plugin") or kind.endswith(".yaml"), title
            if plugin:
                source = f"from qgs.contracts import *\n{content}"
                install(f"qgs-{plugin}", plugin, source, version="0.7")
            else:
                Path(kind).write_text(content)
        wrong += [f"{title}: {fault}" for fault in faults(files)]
    assert len(cases) > 10
    assert not wrong, "\n".join(wrong)
