"""From what a user names to an exhibition: models side by side, on the scenes that judge them."""

from collections.abc import Sequence

from qgs.data.domain import Domain, verdict
from qgs.data.evaluation import evaluation_samples, true_depth
from qgs.data.sampling import Sample
from qgs.io.checkpoint import load
from qgs.wording import listed
from qgs_viewer import contest
from qgs_viewer.curves import curves_of
from qgs_viewer.figures.exhibits import Exhibition, exhibit


def open_exhibition(
    names: Sequence[str],
    photos: str | None = None,
    scene: str | None = None,
    query: int | None = None,
    device: str = "cpu",
) -> Exhibition:
    """The models `names` on the scenes of their recipe's evaluation, or on photos held out.

    scene: of the exhibits and of the first samples; the first one by default. Raises as
    `contest.recipes_alike` and the data do, and ValueError for an unknown scene or query.
    """
    files = contest.checkpoints(names)
    recipe = next(iter(contest.recipes_alike(files, photos).values()))
    source = recipe.build_data()
    samples = _first(evaluation_samples(source, recipe.views, recipe.evaluation), scene)
    exhibits, found, notes = [], Domain(), dict[str, list[str]]()
    found.see(samples[0].inputs.cameras, samples[0].targets.cameras)
    for name, file in files.items():
        model = load(file, device)
        exhibits.append(exhibit(name, model, samples[0], curves_of(file)))
        if photos is not None and (said := verdict(model.trained_on or Domain(), found)):
            notes.setdefault(said, []).append(name)
        if query is not None:
            exhibits[-1].notable(1, exhibits[-1].sample.inputs.cameras, query)
    told = [f"{', '.join(models)}: {said}." for said, models in notes.items()]
    if recipe.views.scale == "auto":
        told.append(contest.AUTO_SCALE)
    depths = [true_depth(source, sample) for sample in samples]
    return Exhibition(exhibits, samples, depths, query, told)


def _first(samples: Sequence[Sample], scene: str | None) -> list[Sample]:
    """`samples`, those of `scene` first."""
    names = list(dict.fromkeys(sample.scene for sample in samples))
    if scene is not None and scene not in names:
        raise ValueError(f"--scene: {scene!r} is not judged; scenes are {listed(names)}")
    return sorted(samples, key=lambda sample: sample.scene != scene)
