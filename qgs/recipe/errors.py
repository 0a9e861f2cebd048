"""Problems of a recipe: where each one is, why, and how to fix it."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NoReturn

from qgs.contracts import Problem
from qgs.wording import counted


@dataclass(frozen=True)
class Origin:
    """File and line in which a value of a recipe is written; line 0 if the line is unknown."""

    file: str
    line: int = 0

    def __str__(self) -> str:
        return f"{self.file}:{self.line}" if self.line else self.file


@dataclass(frozen=True)
class RecipeProblem(Problem):
    """A mistake in a recipe.

    option: dotted path of the option, "" for the whole recipe.
    file: the file as the user named it, "--set #n" for the n-th override, "<mapping>" for a Python
        mapping.
    line: 1-based; 0 if the line is unknown.
    cause: the exception that a plugin's code raised; None for other mistakes.
    """

    file: str
    line: int
    cause: Exception | None = field(default=None, compare=False, repr=False)

    def __str__(self) -> str:
        return f"{self.place}\n  why: {self.reason}\n  fix: {self.fix}"

    @property
    def place(self) -> str:
        """File, line and option of the mistake, for messages."""
        return f"{Origin(self.file, self.line)}: {self.option or 'recipe'}"


class RecipeError(ValueError):
    """Error for an invalid recipe. `problems` holds all problems, sorted by file and line.

    what: what the message calls the file, such as "recipe".
    """

    def __init__(self, problems: Iterable[RecipeProblem], what: str = "recipe") -> None:
        # A template of the decoder may be refused once for each of its layers.
        ordered = sorted(set(problems), key=lambda p: (p.file, p.line, p.option, p.reason, p.fix))
        self.problems = tuple(ordered)
        title = f"{counted(len(ordered), 'problem')} in the {what}"
        super().__init__("\n".join([title, *map(str, ordered)]))


class Problems:
    """Collector of a recipe's problems, so that one error can report all of them.

    what: what the message calls the file, such as "recipe". found: the problems in the order in
        which they were added.
    """

    def __init__(self, what: str = "recipe") -> None:
        self.what = what
        self.found: list[RecipeProblem] = []

    def stop(self, origin: Origin, path: str | Iterable[str], reason: str, fix: str) -> NoReturn:
        """Add a mistake that prevents further checks, then raise RecipeError with all problems."""
        # Checks of the rest would mislead.
        self.add(origin, path, reason, fix)
        raise RecipeError(self.found, self.what)

    def add(
        self,
        origin: Origin,
        path: str | Iterable[str],
        reason: str,
        fix: str,
        cause: Exception | None = None,
    ) -> None:
        """Add a mistake without raising. path: path of the option, dotted or as a list of keys."""
        option = path if isinstance(path, str) else ".".join(path)
        self.found.append(RecipeProblem(option, reason, fix, origin.file, origin.line, cause))

    def raise_any(self) -> None:
        """Raise RecipeError if there are problems. Exceptions of plugins become its `__cause__`."""
        if self.found:
            error = RecipeError(self.found, self.what)
            causes = [problem.cause for problem in error.problems if problem.cause]
            raise error from (ExceptionGroup("failures of plugins", causes) if causes else None)
