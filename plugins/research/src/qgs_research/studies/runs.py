"""The runs of a study and the files in its folder."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from qgs.files import write_text
from qgs.recipe import Recipe, resolve
from qgs.recipe.errors import Origin
from qgs.recipe.files import merge
from qgs.recipe.recipe import annotated, differing_options
from qgs.recipe.yaml_text import MapNode, from_plain
from qgs.wording import counted
from qgs_research.studies.study import MAIN, Study

BESIDE = ("seed", "plugins")
"""Keys of a recipe that are ignored when the recipes of variants are compared."""


@dataclass(frozen=True)
class Run:
    """Training of one variant with one seed.

    folder: run folder, with the same files as the run folder of `qgs train`.
    """

    variant: str
    seed: int
    folder: Path

    def __str__(self) -> str:
        return f"{self.variant} seed {self.seed}"

    def beside(self, suffix: str) -> Path:
        """Return the path of a file next to the run folder: `beside("lock")` is `seed-0.lock`."""
        return self.folder.with_name(f"{self.folder.name}.{suffix}")

    @property
    def log(self) -> Path:
        """Path of the file with the printed output of the run."""
        return self.beside("log")

    @property
    def failure(self) -> Path:
        """Path of the file with the error of a failed run."""
        return self.beside("failed")

    @property
    def failed(self) -> str:
        """First sentence of the error of a failed run; "" if the run has not failed."""
        if not self.failure.is_file():
            return ""
        # The rest of the file is advice, which has no room in tables.
        first_line = self.failure.read_text(encoding="utf-8").strip().split("\n")[0]
        return first_line.partition(". ")[0]

    def evaluation(self, name: str) -> Path:
        """Return the folder for the results of this run in the evaluation `name`."""
        return self.folder / (f"evaluation-{name}" if name else "evaluation")

    def evaluated(self, name: str) -> bool:
        """Return True if the results of this run in the evaluation `name` are complete."""
        # An evaluation writes this file last.
        return (self.evaluation(name) / "protocol.json").is_file()


@dataclass(frozen=True)
class Plan:
    """Runs and evaluations of a study in `folder`.

    recipes: checked recipe of each variant, by name of the variant. All have the study's first
    seed.
    """

    study: Study
    folder: Path
    recipes: Mapping[str, Recipe]

    @property
    def evaluations(self) -> list[str]:
        """Names of all evaluations. The first is "", the default evaluation."""
        return [MAIN, *self.study.evaluations]

    @property
    def runs(self) -> list[Run]:
        """All runs of the study: each variant with the first seed, then with the second, ..."""
        seeds = self.study.settings.seeds
        # Seeds come first, so that an unfinished study has complete comparisons.
        return [run_of(self.folder, name, seed) for seed in seeds for name in self.recipes]

    @property
    def size(self) -> str:
        """Size of the study, for example "4 variants x 3 seeds"."""
        variants = counted(len(self.recipes), "variant")
        return f"{variants} x {counted(len(self.study.settings.seeds), 'seed')}"

    def evaluation_recipe(self, variant: str, evaluation: str) -> Recipe:
        """Return the recipe of `variant`, changed as the evaluation `evaluation` says."""
        recipe = self.recipes[variant]
        changes = self.study.evaluations.get(evaluation)
        return changed_recipe(recipe, changes) if changes else recipe

    def done(self, run: Run) -> bool:
        """Return True if all evaluations of `run` are complete."""
        return all(map(run.evaluated, self.evaluations))


def run_of(folder: Path, variant: str, seed: int) -> Run:
    """Return the run of `variant` with `seed` in the study folder `folder`."""
    return Run(variant, seed, folder / "runs" / variant / f"seed-{seed}")


def recipe_file(folder: Path, variant: str, evaluation: str = MAIN) -> Path:
    """Return the path of a variant's checked recipe in the study folder.

    By default it is the recipe for training; with `evaluation`, the recipe for this evaluation.
    """
    # Names have no @, which separates variant and evaluation in hypotheses too.
    name = f"{variant}@{evaluation}" if evaluation else variant
    return folder / "variants" / f"{name}.yaml"


def changed_recipe(recipe: Recipe, changes: MapNode) -> Recipe:
    """Return `recipe` with the changes of an evaluation. Raises RecipeError for invalid options."""
    tree = from_plain(recipe.tree, Origin("the variant"))
    assert isinstance(tree, MapNode)
    return resolve(merge(tree, changes))


def write_plan(plan: Plan) -> None:
    """Write the checked recipes of all variants, which the training processes read."""
    for variant, evaluation in product(plan.recipes, plan.evaluations):
        # Include the file and line that set each value, for readers of the folder.
        text = annotated(plan.evaluation_recipe(variant, evaluation))
        write_text(recipe_file(plan.folder, variant, evaluation), f"{text}\n")


def differences(ours: Recipe, theirs: Recipe) -> dict[str, tuple[str | None, str | None]]:
    """Return the options in which two recipes differ: pairs of values, by path of the option.

    A missing value is None. The options `seed` and `plugins` are left out.
    """
    found = differing_options(ours.tree, theirs.tree)
    return {path: values for path, values in found.items() if path not in BESIDE}
