"""The runs of a study, and the files of its folder."""

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
from qgs_research.studies.hypotheses import MAIN
from qgs_research.studies.study import Study

BESIDE = ("seed", "plugins")
"""What does not make a recipe another model."""


@dataclass(frozen=True)
class Run:
    """One training of a variant. folder: where it is, as `qgs train` leaves it."""

    variant: str
    seed: int
    folder: Path

    def __str__(self) -> str:
        return f"{self.variant} seed {self.seed}"

    def beside(self, suffix: str) -> Path:
        """A file beside the folder, such as the lock."""
        return self.folder.with_name(f"{self.folder.name}.{suffix}")

    @property
    def log(self) -> Path:
        """The output of its processes."""
        return self.beside("log")

    @property
    def failure(self) -> Path:
        """The reason why it failed, where it did."""
        return self.beside("failed")

    @property
    def failed(self) -> str:
        """Why it failed, the first sentence, until that file is deleted; "" where it did not."""
        if not self.failure.is_file():
            return ""
        # The rest of the file is advice, and tables have no room for it.
        first_line = self.failure.read_text(encoding="utf-8").strip().split("\n")[0]
        return first_line.partition(". ")[0]

    def evaluation(self, name: str) -> Path:
        """The folder of its results by one evaluation."""
        return self.folder / (f"evaluation-{name}" if name else "evaluation")

    def evaluated(self, name: str) -> bool:
        """True if that evaluation is there, as a whole."""
        # The last file that an evaluation writes.
        return (self.evaluation(name) / "protocol.json").is_file()


@dataclass(frozen=True)
class Plan:
    """What is to be trained and evaluated in `folder`. recipes: by variant, with the first seed."""

    study: Study
    folder: Path
    recipes: Mapping[str, Recipe]

    @property
    def evaluations(self) -> list[str]:
        """Names of all evaluations, the recipes' own first."""
        return [MAIN, *self.study.evaluations]

    @property
    def runs(self) -> list[Run]:
        """All runs, every variant with the first seed, then with the next."""
        seeds = self.study.settings.seeds
        # By seed first: an unfinished study then has whole comparisons.
        return [run_of(self.folder, name, seed) for seed in seeds for name in self.recipes]

    @property
    def size(self) -> str:
        """Such as "4 variants x 3 seeds"."""
        variants = counted(len(self.recipes), "variant")
        return f"{variants} x {counted(len(self.study.settings.seeds), 'seed')}"

    def evaluation_recipe(self, variant: str, evaluation: str) -> Recipe:
        """The recipe of a variant as an evaluation changes it."""
        recipe = self.recipes[variant]
        changes = self.study.evaluations.get(evaluation)
        return changed_recipe(recipe, changes) if changes else recipe

    def done(self, run: Run) -> bool:
        """True if nothing of `run` is missing."""
        return all(map(run.evaluated, self.evaluations))


def run_of(folder: Path, variant: str, seed: int) -> Run:
    """Return the run of a variant with a seed, of the study in `folder`."""
    return Run(variant, seed, folder / "runs" / variant / f"seed-{seed}")


def recipe_file(folder: Path, variant: str, evaluation: str = MAIN) -> Path:
    """The resolved recipe of the runs of a variant, in training or as an evaluation changes it."""
    # No name has an @: hypotheses write it between a variant and an evaluation, too.
    name = f"{variant}@{evaluation}" if evaluation else variant
    return folder / "variants" / f"{name}.yaml"


def changed_recipe(recipe: Recipe, changes: MapNode) -> Recipe:
    """Return `recipe` as an evaluation changes it; raises RecipeError."""
    tree = from_plain(recipe.tree, Origin("the variant"))
    assert isinstance(tree, MapNode)
    return resolve(merge(tree, changes))


def write_plan(plan: Plan) -> None:
    """Write the recipes that the runs' processes read."""
    for variant, evaluation in product(plan.recipes, plan.evaluations):
        # With the file and line that set each value, for those who read the folder.
        text = annotated(plan.evaluation_recipe(variant, evaluation))
        write_text(recipe_file(plan.folder, variant, evaluation), f"{text}\n")


def differences(ours: Recipe, theirs: Recipe) -> dict[str, tuple[str | None, str | None]]:
    """Return options in which two recipes differ, seeds and names of plugins aside."""
    found = differing_options(ours.tree, theirs.tree)
    return {path: values for path, values in found.items() if path not in BESIDE}
