"""Problems of a recipe at the line that caused them.

A file or an override laid over others may replace a component that theirs rely on. Then its line is
to blame, and not those that were right before.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

from qgs.contracts import Plugin
from qgs.recipe.checks import check
from qgs.recipe.decode import Chosen
from qgs.recipe.errors import Problems, RecipeError, RecipeProblem
from qgs.recipe.sections import Draft, draft_of
from qgs.recipe.yaml_text import KeyPath, MapNode


def at_their_causes(
    draft: Draft, written: MapNode, found: Sequence[RecipeProblem], plugins: Sequence[Plugin]
) -> Iterator[RecipeProblem]:
    """`found`, what is wrong with the draft of `written`; those of one cause become one problem."""
    drafts = [draft]
    # Only a recipe that is refused is read once more for each layer.
    with suppress(RecipeError):
        while written.under is not None:
            written = written.under
            drafts.append(draft_of(written, Problems(), plugins))
    blames = _blames(found, drafts)
    caused: dict[RecipeProblem, list[RecipeProblem]] = {}
    for problem in found:
        blame = blames.get(problem, problem)
        # Whoever wrote both sees the contradiction where it is; a plug-in's failure is its own.
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
    found: Sequence[RecipeProblem], drafts: Sequence[Draft]
) -> dict[RecipeProblem, RecipeProblem]:
    """The problem of the line with which each of `found` came, where a component was replaced.

    drafts: the whole recipe, and before each file or override that was laid over it, newest first.
    """
    blames: dict[RecipeProblem, RecipeProblem] = {}
    left = list(found)
    for newer, older in pairwise(drafts):
        known = _told(older)
        fresh = [problem for problem in left if problem not in known]
        left = [problem for problem in left if problem in known]
        # Changes are made one after the other until the problem is there: the last one brought it.
        parts = dict(older.parts)
        for changed in _changes(newer, older) if fresh else ():
            path, new = next(iter(changed.items()))
            old = parts.get(path)
            parts |= changed
            now = _told(replace(older, parts=parts))
            for problem in [problem for problem in fresh if problem in now]:
                fresh.remove(problem)
                if old:
                    blames[problem] = _replacing(new, old)
    return blames


def _changes(newer: Draft, older: Draft) -> list[dict[KeyPath, Chosen]]:
    """Components that a layer changed, those of one line together, in the order of a recipe."""
    changed: dict[KeyPath, dict[KeyPath, Chosen]] = {}
    for path, part in newer.parts.items():
        old = older.parts.get(path)
        if old is None or not part.equals(old):
            changed.setdefault(part.source, {})[path] = part
    return [*changed.values()]


def _told(draft: Draft) -> set[RecipeProblem]:
    problems = Problems()
    with suppress(RecipeError):
        check(draft, problems)
    return set(problems.found)


def _replacing(new: Chosen, old: Chosen) -> RecipeProblem:
    """The problem of the line that put `new`, or options of it, in place of `old`."""
    changed = [key for key in new.node if new.options.get(key) != old.options.get(key)]
    option = new.shown_path
    origin = new.node.origins.get("type", new.origin)
    reason = f"`{new.type}` in place of `{old.type}` ({old.chosen_at})"
    if new.type == old.type and changed:
        option = f"{new.shown_path}.{changed[0]}"
        origin = new.node.origins[changed[0]]
        reason = f"another {' and '.join(changed)} of `{new.type}` than at {old.origin}"
    return RecipeProblem(option, reason, f"keep `{old.type}` as it was", origin.file, origin.line)
