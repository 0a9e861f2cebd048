"""What is wrong with a recipe: every problem with its place, its reason and a fix."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from difflib import get_close_matches

from qgs.composer.nodes import Origin


@dataclass(frozen=True, order=True)
class RecipeProblem:
    """One mistake.

    file: as the user named it, "--set #n" for the n-th override, "<mapping>" for a Python mapping.
    line: 1-based, 0 where there is none. path: dotted path in the recipe, "" for the whole of it.
    cause: what a plugin's code raised, None where nothing was.
    """

    file: str
    line: int
    path: str
    reason: str
    fix: str
    cause: Exception | None = field(default=None, compare=False, repr=False)

    def __str__(self) -> str:
        place = f"{Origin(self.file, self.line)}: {self.path or 'recipe'}"
        return f"{place}\n  why: {self.reason}\n  fix: {self.fix}"


class RecipeError(ValueError):
    """A recipe that cannot work. `problems` holds all that were found, by file and line."""

    def __init__(self, problems: Iterable[RecipeProblem]) -> None:
        self.problems = tuple(sorted(set(problems)))
        count = len(self.problems)
        title = "1 problem" if count == 1 else f"{count} problems"
        super().__init__("\n".join([f"{title} in the recipe", *map(str, self.problems)]))


class Problems:
    """Collects problems while a recipe is read, so that all come at once."""

    def __init__(self) -> None:
        self._found: list[RecipeProblem] = []
        self._stopped = False

    def stop(self, origin: Origin, path: str, reason: str, fix: str) -> None:
        """Note a mistake that hides part of the recipe: reading on would only mislead."""
        self.add(origin, path, reason, fix)
        self._stopped = True

    def add(
        self, origin: Origin, path: str, reason: str, fix: str, cause: Exception | None = None
    ) -> None:
        """Note a mistake and go on."""
        self._found.append(RecipeProblem(origin.file, origin.line, path, reason, fix, cause))

    def raise_if_stopped(self) -> None:
        """Raise RecipeError if part of the recipe could not be read."""
        if self._stopped:
            self.raise_any()

    def raise_any(self) -> None:
        """Raise RecipeError if anything was found, from what plugins raised if they did."""
        if not self._found:
            return
        error = RecipeError(self._found)
        causes = [problem.cause for problem in error.problems if problem.cause]
        if not causes:
            raise error
        raise error from causes[0] if len(causes) == 1 else ExceptionGroup("of plugins", causes)


def nearest(word: str, choices: Iterable[str]) -> str | None:
    """The choice that `word` is probably a misspelling of."""
    found = get_close_matches(word, sorted(choices), n=1, cutoff=0.6)
    return found[0] if found else None


def did_you_mean(word: str, choices: Iterable[str], noun: str) -> str:
    """A fix: the nearest choice, or all of them."""
    choices = sorted(choices)
    near = nearest(word, choices)
    if near is not None:
        return f"did you mean `{near}`?"
    return f"{noun}: {', '.join(choices)}" if choices else f"there are no {noun} here: remove it"
