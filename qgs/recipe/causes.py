"""Search for the line that caused a problem of a recipe.

A file or an override may replace a component or an option on which other lines of the recipe rely.
The problem is then reported at the line of the replacement, not at these other lines, which were
correct without it.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

from qgs.contracts import Plugin
from qgs.recipe.checks import check
from qgs.recipe.errors import Origin, Problems, RecipeError, RecipeProblem
from qgs.recipe.files import KINDS, merge
from qgs.recipe.sections import Draft, draft_of
from qgs.recipe.yaml_text import KeyPath, MapNode, brief, find


def at_their_causes(
    written: MapNode, found: Sequence[RecipeProblem], plugins: Sequence[Plugin]
) -> Iterator[RecipeProblem]:
    """Yield the problems `found` in the recipe `written`, moved to the lines that caused them.

    Problems with the same cause become one.
    plugins: Plugin objects that are used in place of installed plugins of the same names.
    """
    blames: dict[RecipeProblem, RecipeProblem] = {}
    left = {*found}
    # Only a refused recipe is read again for each layer.
    with suppress(RecipeError):
        while left and written.under is not None:
            older = draft_of(written.under, Problems(), plugins)
            known = _told(older)
            if fresh := left - known:
                blames |= _blames(fresh, older, written, plugins)
            left &= known
            written = written.under
    caused: dict[RecipeProblem, list[RecipeProblem]] = {}
    for problem in found:
        blame = blames.get(problem, problem)
        # Within one file, both lines are visible. A plug-in's failure has no other cause.
        if blame.file == problem.file or problem.cause:
            yield problem
        else:
            caused.setdefault(blame, []).append(problem)
    for blame, broken in caused.items():
        # The layers of a decoder may have the same problem.
        told = dict.fromkeys(f"{problem.place}: {problem.reason}" for problem in broken)
        fixes = dict.fromkeys(problem.fix for problem in broken)
        reason = "\n    ".join([f"{blame.reason} breaks:", *told])
        yield replace(blame, reason=reason, fix=f"{blame.fix}, or: {'; '.join(fixes)}")


def _blames(
    found: set[RecipeProblem], before: Draft, written: MapNode, plugins: Sequence[Plugin]
) -> dict[RecipeProblem, RecipeProblem]:
    """Map each problem in `found` to a new problem, at the line that caused it.

    The last file or override, `written.over`, was merged into `written.under`, which gave
    `written`. This function merges the options of `written.over` one by one. The option after which
    a problem first appears is its cause.
    found: problems that `written` has and `written.under` does not have. before: draft of
        `written.under` (recipe with components chosen, not yet checked).
    """
    blames: dict[RecipeProblem, RecipeProblem] = {}
    base: Any = written.under
    for path, value, origin in _options(written.over):
        piece = value
        for key in reversed(path):
            piece = MapNode(origin, [(key, piece, origin)])
        base = merge(base, piece)
        # Options that only make sense together are refused one by one.
        with suppress(RecipeError):
            after = draft_of(base, Problems(), plugins)
            blame = _replacing(after, before) or _changing(path, value, origin, before)
            for problem in _told(after) & found:
                blames.setdefault(problem, blame or problem)
            before = after
    return blames


def _options(over: MapNode, above: KeyPath = ()) -> Iterator[tuple[KeyPath, Any, Origin]]:
    """Yield path, value and origin (file and line) of each option in the mapping `over`.

    Options such as `type`, which decide which other options are valid, come first.
    """
    first = ("plugins", "type", *KINDS)
    for key, value, origin in sorted(over.entries(), key=lambda entry: entry[0] not in first):
        path = (*above, key)
        # A swap replaces an older swap completely.
        if isinstance(value, MapNode) and value and above != ("swap",):
            yield from _options(value, path)
        else:
            yield path, value, origin


def _told(draft: Draft) -> set[RecipeProblem]:
    problems = Problems()
    with suppress(RecipeError):
        check(draft, problems)
    return set(problems.found)


def _replacing(after: Draft, before: Draft) -> RecipeProblem | None:
    """Return a problem at the line that replaced a component; None if no component was replaced.

    before, after: drafts of the recipe without and with that line.
    """
    for path, new in after.parts.items():
        old = before.parts.get(path, new)
        if new.type != old.type:
            origin = new.node.origins.get("type", new.origin)
            reason = f"`{new.type}` in place of `{old.type}` ({old.chosen_at})"
            fix = f"keep `{old.type}`"
            return RecipeProblem(new.shown_path, reason, fix, origin.file, origin.line)
    return None


def _changing(path: KeyPath, value: Any, origin: Origin, before: Draft) -> RecipeProblem | None:
    """Return a problem at the line that changed the option `path`; None if `path` ends in "type".

    before: draft of the recipe without the change.
    """
    if path[-1] == "type":
        return None
    taken, place, old = find(before.tree, path)
    was = f"{brief(old)} ({place})" if len(taken) == len(path) else "the default"
    reason = f"{brief(value)} in place of {was}"
    return RecipeProblem(".".join(path), reason, f"keep {was}", origin.file, origin.line)
