"""Problems of a recipe at the line that caused them.

A file or an override laid over others may replace a component that theirs rely on. Then its line is
to blame, and not those that were right before.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

from qgs.contracts import Plugin
from qgs.recipe.checks import check
from qgs.recipe.decode import Chosen
from qgs.recipe.draft import Draft, draft_of
from qgs.recipe.errors import Problems, RecipeProblem


def at_their_causes(
    draft: Draft, found: Sequence[RecipeProblem], plugins: Sequence[Plugin]
) -> Iterator[RecipeProblem]:
    """`found`, what is wrong with `draft` as a whole; those of one cause become one problem."""
    drafts = [draft]
    # Only a recipe that is refused is read once more for each layer.
    while found and (under := drafts[-1].written.under) is not None:
        drafts.append(draft_of(under, Problems(), plugins))
    caused: dict[RecipeProblem, list[RecipeProblem]] = {}
    for problem in found:
        blame = _blamed(problem, drafts)
        # Whoever wrote both sees the contradiction where it is.
        if blame is None or blame.file == problem.file:
            yield problem
        else:
            caused.setdefault(blame, []).append(problem)
    for blame, broken in caused.items():
        # The layers of a decoder may have the same problem.
        told = dict.fromkeys(f"{problem.place}: {problem.reason}" for problem in broken)
        fixes = dict.fromkeys(problem.fix for problem in broken)
        reason = "\n    ".join([f"{blame.reason} breaks:", *told])
        yield replace(blame, reason=reason, fix=f"{blame.fix}, or: {'; '.join(fixes)}")


def _blamed(problem: RecipeProblem, drafts: Sequence[Draft]) -> RecipeProblem | None:
    """The problem of the line with which `problem` came.

    drafts: the whole recipe, and before each file or override that was laid over it, newest first.
    """
    for newer, older in pairwise(drafts):
        if _has(older, problem):
            continue
        # Changes are made one after the other until the problem is there: the last one brought it.
        parts = dict(older.parts)
        for source in {part.place.source: None for part in newer.parts.values() if part}:
            changed = {
                path: part
                for path, part in newer.parts.items()
                if part and part.place.source == source and not part.equals(parts.get(path))
            }
            if not changed:
                continue
            path, new = next(iter(changed.items()))
            old = parts.get(path)
            parts |= changed
            if _has(replace(older, parts=parts), problem):
                return _replacing(new, old) if old else None
        return None
    return None


def _has(draft: Draft, problem: RecipeProblem) -> bool:
    problems = Problems()
    check(draft, problems)
    return (problem.place, problem.reason) in [(x.place, x.reason) for x in problems.found]


def _replacing(new: Chosen, old: Chosen) -> RecipeProblem:
    """The problem of the line that put `new`, or options of it, in place of `old`."""
    changed = [key for key in new.node if new.options.get(key) != old.options.get(key)]
    option = new.path
    origin = new.node.origins.get("type", new.place.origin)
    reason = f"`{new.type}` in place of `{old.type}` ({old.chosen_at})"
    if new.type == old.type and changed:
        option = f"{new.path}.{changed[0]}"
        origin = new.node.origins[changed[0]]
        reason = f"another {' and '.join(changed)} of `{new.type}` than at {old.place.origin}"
    return RecipeProblem(option, reason, f"keep `{old.type}` as it was", origin.file, origin.line)
