"""From what a user names to figures: models on scenes, PDF and PNG files, and figures.md."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from qgs.checkpoint.model_file import load
from qgs.domain import Domain, verdict
from qgs.evaluate.plan import evaluation_samples
from qgs.files import write_text
from qgs.reconstruction.scale import ScaleSearch
from qgs.wording import listed
from qgs_viewer import contest
from qgs_viewer.curves import curves_figure, curves_of
from qgs_viewer.figures import anchors, attention, dispersion, global_gaussians, novel_views
from qgs_viewer.figures.exhibits import Exhibition, NothingToShowError, exhibit
from qgs_viewer.figures.paper import WIDTH, Made, paper_style, write_figure
from qgs_viewer.scales import summary


@paper_style()
def curves(show: Exhibition) -> Made:
    """Loss and PSNR of the training views. Raises NothingToShowError where no run has a history."""
    found = {e.name: e.curves for e in show.exhibits if e.curves is not None}
    without = [e.name for e in show.exhibits if e.curves is None]
    missing = f"{', '.join(without)}: no history.jsonl beside the checkpoint, so no training curve"
    if not found:
        raise NothingToShowError(f"{missing}; run folders of `qgs train` have one")
    caption = (
        "Training loss and PSNR of the training views by seconds, or where a training took over "
        "two hours by steps: records of the history pale, their running mean strong."
        + (f" {missing}." if without else "")
    )
    figure = curves_figure(found)
    figure.set_size_inches(WIDTH, 2.3)
    return Made(figure, caption)


FIGURES: Mapping[str, Callable[[Exhibition], Made]] = {
    "global_gaussians": global_gaussians.made,
    "novel_views": novel_views.made,
    "anchors": anchors.anchors,
    "refinement": anchors.refinement,
    "cross_attention": attention.cross_attention,
    "self_attention": attention.self_attention,
    "dispersion": dispersion.made,
    "curves": curves,
}
LISTING = "figures.md"


def open_exhibition(
    runs: Sequence[str],
    photos: str | None = None,
    scene: str | None = None,
    query: int | None = None,
    device: str = "cpu",
) -> Exhibition:
    """The models `runs` on the scenes of their recipe's evaluation, or on photos held out.

    A scale that is searched is that of the first model, for all figures to have one world.

    scene: of the exhibits and of the first samples; the first one by default. Raises ValueError for
    an unknown scene or query, and as `contest.recipes_alike`.
    """
    files = contest.checkpoints(runs)
    recipe = next(iter(contest.recipes_alike(files, photos).values()))
    source = recipe.build_data()
    models = {name: load(file, device) for name, file in files.items()}
    first = next(iter(models))
    search, sampler = ScaleSearch(models[first], recipe.views), recipe.build_view_sampler()
    if photos is not None:
        sampler = contest.PhotoWindows(models[first].trained_on or Domain())
    choices = {"views_of": search, "depths": True}
    samples = evaluation_samples(source, recipe.views, recipe.evaluation, sampler, **choices)
    names = dict.fromkeys(sample.scene for sample in samples)
    if scene is not None and scene not in names:
        raise ValueError(f"--scene: {scene!r} is not judged; scenes are {listed(names)}")
    samples = sorted(samples, key=lambda sample: sample.scene != scene)
    exhibits, found, notes = [], Domain(), dict[str, list[str]]()
    found.see(samples[0].inputs.cameras, samples[0].targets.cameras)
    options = ["scale"] if search.found else []
    for name, model in models.items():
        exhibits.append(exhibit(name, model, samples[0], curves_of(files[name])))
        if photos is not None and (remark := verdict(model.trained_on or Domain(), found, options)):
            notes.setdefault(remark, []).append(name)
        if query is not None:
            exhibits[-1].notable(1, exhibits[-1].sample.inputs.cameras, query)
    remarks = [f"{', '.join(models)}: {remark}." for remark, models in notes.items()]
    if search.found:
        remarks.append(f"{first}: {summary(search.found.values(), option='')}.")
    if recipe.views.scale == "auto":
        remarks.append(contest.AUTO_SCALE)
    return Exhibition(exhibits, samples, query, remarks)


def refuse_unknown(names: Sequence[str]) -> None:
    """Raise ValueError for a name that is no figure's."""
    if unknown := [name for name in names if name not in FIGURES]:
        raise ValueError(f"--only: no figure {listed(unknown)}; there are {listed(FIGURES, 20)}")


def write_all(show: Exhibition, folder: Path, names: Sequence[str] = ()) -> Iterator[str]:
    """Write the figures `names`, all by default, and yield a line on each."""
    texts = [f"# {' and '.join(show.models)}", *show.notes]
    for name in names or FIGURES:
        try:
            made = FIGURES[name](show)
        except NothingToShowError as error:
            yield f"left out {name}: {error}"
            texts.append(f"{name} is left out: {error}.")
            continue
        write_figure(made.figure, folder, name)
        yield f"{folder / name}.pdf, .png"
        texts.append(f"## {name}\n\n![{name}]({name}.png)\n\n{made.caption} ([PDF]({name}.pdf))")
    write_text(folder / LISTING, "\n\n".join(texts) + "\n")
    yield f"{folder / LISTING}: what each shows"
