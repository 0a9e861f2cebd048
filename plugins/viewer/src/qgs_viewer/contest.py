"""Models side by side: trained under one budget or loaded, one protocol of evaluation, a report."""

import os
import platform
import signal
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import torch
import typer
import yaml
from rich import box
from rich.table import Table

from qgs.checkpoint.model_file import CheckpointFile
from qgs.checkpoint.models import about, checkpoint_path
from qgs.contracts import Scene, ViewsConfig
from qgs.data.inputs import Window, choose_windows
from qgs.data.recognition import is_training_data, open_for
from qgs.data.view_samplers import Span
from qgs.domain import Domain
from qgs.evaluate.evaluation import evaluate
from qgs.evaluate.plan import evaluation_samples
from qgs.evaluate.results import Evaluation
from qgs.metrics.baselines import BASELINES
from qgs.recipe import Recipe, resolve
from qgs.recipe.schema import summary_of
from qgs.reconstruction.scale import ScaleSearch, photo_settings
from qgs.reconstruction.scenes import (
    Size,
    holding_out,
    installed_sources,
    size_multiple,
    whole_size,
)
from qgs.train.distributed import choose_device
from qgs.train.training import train
from qgs.wording import counted, listed, short_names
from qgs_viewer.curves import Curves, curves_of
from qgs_viewer.report import Contender, Report
from qgs_viewer.scales import summary

PICTURED_SCENES = 6
WINDOWS = 6  # scenes, and windows of a scene, that are judged of a user's photos
AUTO_SCALE = "Each scene is scaled until what its cameras look at is 1 away (views.scale: auto)."
JUDGED = ("data", "views", "evaluation", "metrics")
TRAINED = ("optimizer", "training")
"""Sections of recipes that must be equal, so that only the models differ."""
OF_THE_METHOD = (
    "optimizer.parts", "training.judge_inputs", "evaluation.tuning", "evaluation.tuning_rate",
    "views.scale", "views.scale_factor",
)  # fmt: skip
"""Options in them that may differ: how a method trains, tuning, which nobody does here, and the
unit of a model's world, which no score depends on."""


class PhotoWindows(Span):
    """WINDOWS windows of each scene by `choose_windows`, chosen once."""

    def __init__(self, trained_on: Domain) -> None:
        super().__init__(Span.Config())
        self._trained_on, self._known = trained_on, dict[str, list[Window]]()

    def windows(self, scene: Scene, views: ViewsConfig) -> list[Window]:
        """See `ViewSampler`; scenes that move have none."""
        if scene.times is not None:
            return []
        if scene.name not in self._known:
            windows = choose_windows(scene, views, self._trained_on, WINDOWS)
            if not any(compared for _, compared in windows):
                raise ValueError(
                    f"all {len(scene)} photos are inputs, none is left to compare with: add one "
                    "between them, or see what a model makes of them by qgs view MODEL PHOTOS"
                )
            self._known[scene.name] = windows
        return self._known[scene.name]


@dataclass(frozen=True)
class Entry:
    """A judged model with its recipe. progress: how far its training has come.

    search: the scales that were found for it. windows: of a user's photos.
    """

    recipe: Recipe
    contender: Contender
    evaluation: Evaluation
    search: ScaleSearch
    progress: str = ""
    windows: PhotoWindows | None = None


def resolve_fairly(files: Sequence[Path], seconds: float, seed: int) -> dict[str, Recipe]:
    """Recipes by short name, under one time budget and seed.

    Raises ValueError when two files differ in anything but model, losses and `OF_THE_METHOD`.
    """
    overrides = [f"training.seconds={seconds}", "training.steps=1000000000", f"seed={seed}"]
    names = short_names(files)
    recipes = {name: resolve(f, overrides) for name, f in zip(names, files, strict=True)}
    refuse_unequal(recipes, (*JUDGED, *TRAINED))
    return recipes


def refuse_unequal(recipes: Mapping[str, Recipe], sections: Sequence[str]) -> None:
    """Raise ValueError where two recipes differ in `sections`, except in `OF_THE_METHOD`."""

    def compared(section: str, of: Recipe) -> dict[str, Any]:
        options = of.tree[section] or {}
        return {name: x for name, x in options.items() if f"{section}.{name}" not in OF_THE_METHOD}

    first = next(iter(recipes))
    for name, recipe in recipes.items():
        unequal = [s for s in sections if compared(s, recipe) != compared(s, recipes[first])]
        if unequal:
            raise ValueError(
                f"{name} and {first} differ in {', '.join(unequal)}, so their figures could not be "
                "compared; make these parts equal, or take one at a time"
            )


def compete(name: str, recipe: Recipe, run: Path, device: str = "auto") -> Entry:
    """Train and evaluate one recipe. Raises typer.Exit when training was stopped."""
    result = train(recipe, run, device=device)
    if result.stopped_by:
        typer.echo(f"stopped by {result.stopped_by}; no report", err=True)
        raise typer.Exit(128 + signal.Signals[result.stopped_by])
    evaluation = evaluate(result.model, recipe, result.steps)
    evaluation.write(result.folder.evaluation)
    curves = curves_of(result.folder.checkpoint)
    search = ScaleSearch(result.model, recipe.views)
    return entry_of(name, recipe, evaluation, search, describe(recipe), curves)


def checkpoints(names: Sequence[str]) -> dict[str, Path]:
    """Short name to file of each model (see `checkpoint_path`)."""
    return dict(zip(short_names(names), map(checkpoint_path, names), strict=True))


def judge(
    files: Mapping[str, Path],
    photos: str | None,
    device: str,
    size: Size | None = None,
    overrides: Sequence[str] = (),
) -> list[Entry]:
    """The models in `files` on unseen scenes, or on held-out photos; raises as `recipes_alike`."""
    recipes, entries = recipes_alike(files, photos, size, overrides), list[Entry]()
    windows: PhotoWindows | None = None
    for name, path in files.items():
        with CheckpointFile(path) as file:
            model, step = file.model(choose_device(device)), file.step
            training = file.recipe.training
        of = "" if training.seconds else f" of {training.steps:,}"
        progress = "not known" if step is None else f"step {step:,}{of}"
        recipe = recipes[name]
        search, domain = ScaleSearch(model, recipe.views), model.trained_on
        # those of the first model for all, so that one protocol judges them
        if not entries and photos is not None:
            windows = PhotoWindows(domain or Domain())
        evaluation = evaluate(
            model,
            recipe,
            trained_on=domain,
            views_of=search,
            sampler=windows,
        )
        text = about(path) or describe(recipe)
        entry = entry_of(name, recipe, evaluation, search, text, curves_of(path))
        progress = f"{name}: {progress}"
        entries.append(replace(entry, progress=progress, windows=windows))
    return entries


def recipes_alike(
    files: Mapping[str, Path],
    photos: str | None,
    size: Size | None = None,
    overrides: Sequence[str] = (),
) -> dict[str, Recipe]:
    """The recipes of `files`, with the data at `photos` in place of their own.

    size: (H, W) of the photos, by default one that all models take and at which they are whole.
    overrides: settings of `views`, such as a scale.

    Raises ValueError where their protocols differ, and as `CheckpointFile` and the data do.
    """
    recipes = dict[str, Recipe]()
    for name, path in files.items():
        with CheckpointFile(path) as file:
            recipes[name] = file.recipe
    if photos is not None:
        data = _data_of(photos, recipes.values(), size)
        first = next(iter(recipes.values())).tree["views"]
        recipes = {
            name: resolve(_on_photos(recipe, photos, data, first).tree, overrides)
            for name, recipe in recipes.items()
        }
    refuse_unequal(recipes, JUDGED)
    return recipes


def _data_of(photos: str, recipes: Collection[Recipe], size: Size | None) -> dict[str, Any]:
    """The section `data` of the photos for all `recipes`, some photos held out.

    As a recipe that was trained on them opens them, where there is one, so that none of its
    training is judged; else at a size at which they are whole.
    """
    sources, trained = installed_sources(), [recipe.data_config for recipe in recipes]
    config = next((data for data in trained if is_training_data(photos, data)), trained[0])
    source, own = open_for(photos, size, config, sources)
    scene = next(chain(source.scenes("test"), source.scenes("train")), None)
    config = source.config
    if not own and scene is not None:
        size, config = size or whole_size(scene, size_multiple(recipes)), holding_out(config, scene)
    kind = next(name for name, component in sources.items() if component is type(source))
    options = config.model_dump(mode="json")
    return {"type": kind, **options, "image_size": [*(size or config.image_size)]}


def _on_photos(
    recipe: Recipe, photos: str, data: Mapping[str, Any], first: Mapping[str, Any]
) -> Recipe:
    """`recipe` on the photos of `data`, with the choice of views of `first`.

    Photos that it was not trained on have a unit of their own, see `photo_settings`.
    """
    own, plugin = is_training_data(photos, recipe.data_config), data["type"].split("/")[0]
    views = {
        **recipe.tree["views"],
        **{name: first[name] for name in ("gap", "targets")},
        "scale": photo_settings(recipe.views, own).scale,
    }
    tree = {
        **recipe.tree,
        "data": data,
        "plugins": [*dict.fromkeys([*recipe.tree["plugins"], *{plugin} - {"qgs"}])],
        "evaluation": {**recipe.tree["evaluation"], "scenes": WINDOWS, "index": None},
        "views": views,
    }
    return resolve(tree)


def entry_of(
    name: str,
    recipe: Recipe,
    evaluation: Evaluation,
    search: ScaleSearch,
    text: str,
    curves: Curves | None = None,
) -> Entry:
    """A judged model, which moves to the CPU. text: its `about`; curves: see `Contender`.

    search: with the model, and the scales of the windows that it was judged on.
    """
    model = search.model.cpu()
    contender = Contender(
        name=name,
        model=model,
        scores=evaluation.means(),
        gaussians=evaluation.gaussians,
        parameters=sum(p.numel() for p in model.parameters()),
        recipe=yaml.safe_dump(dict(recipe.tree), sort_keys=False, allow_unicode=True),
        about=text,
        curves=curves,
    )
    return Entry(recipe, contender, evaluation, search)


def describe(recipe: Recipe) -> str:
    """The first sentence on its queries, and on the component with which they read the photos."""
    first = ("model", "decoder", "layers", "0")
    readers = (*first, "cross_attention"), (*first, "layer"), ("model", "encoder")
    reader = next(place for place in readers if place in recipe.parts)
    chosen = [recipe.parts[place] for place in (("model", "queries"), reader)]
    more = ["Trained on its input views too."] if recipe.training.judge_inputs else []
    return " ".join([*(f"{part.type}: {summary_of(part.component)}" for part in chosen), *more])


def remarks(entries: Sequence[Entry]) -> list[str]:
    """The remarks of all evaluations and scenes without scores, each once with its models."""
    models: dict[str, list[str]] = {}
    for entry in entries:
        missing = [f"{f.scene} is not judged: {f.reason}" for f in entry.evaluation.missing]
        for remark in (*entry.evaluation.remarks, *missing):
            models.setdefault(remark, []).append(entry.contender.name)
    texts = [f"{', '.join(names)}: {remark}." for remark, names in models.items()]
    auto = [AUTO_SCALE] if entries[0].recipe.views.scale == "auto" else []
    return [*chosen_windows(entries[0]), *scales(entries), *texts, *auto]


def chosen_windows(entry: Entry) -> Iterator[str]:
    """A line on each scene whose windows were chosen, by names of photos in their folder."""
    for score in entry.evaluation.scores if entry.windows else ():
        frames = {frame for window in score.views for part in window for frame in part}
        names = {frame: score.names.get(frame, str(frame)) for frame in frames}
        folder = f"{os.path.commonpath([os.path.dirname(name) for name in names.values()])}/"
        pairs = [
            [listed(names[frame].removeprefix(folder) for frame in part) for part in window]
            for window in score.views
        ]
        text = "; ".join(f"{inputs} ({targets})" for inputs, targets in pairs)
        yield f"{score.scene}, inputs (held-out photos that are judged): {text}"


def scales(entries: Sequence[Entry]) -> list[str]:
    """A sentence for each model whose scales were searched."""
    found = {entry.contender.name: entry.search.found.values() for entry in entries}
    return [f"{name}: {summary(windows)}." for name, windows in found.items() if windows]


def table_of(report: Report) -> Table:
    """The comparison as a table for the terminal."""
    rows, columns = report.contenders, report.columns
    table = Table(title=report.scenes, caption="best in green", box=box.SIMPLE_HEAD)
    table.pad_edge, table.collapse_padding = False, True
    table.add_column("", no_wrap=True)
    for heading in (*(column.title for column in columns.values()), "Gaussians", "parameters"):
        table.add_column(heading, justify="right")
    best = {name: column.best(c.scores[name] for c in rows) for name, column in columns.items()}
    for c in rows:
        cells = []
        for name, column in columns.items():
            score, cell = c.scores[name], column.shown(c.scores[name])
            # cells that read alike are both best
            is_best = score is not None and cell == column.shown(best[name])
            cells.append(f"[green]{cell}[/green]" if is_best else cell)
        table.add_row(c.name, *cells, f"{c.gaussians:,}", f"{c.parameters / 1e6:.2f} M")
    table.add_section()
    for baseline, scores in report.baselines.items():
        cells = [column.shown(scores[name]) for name, column in columns.items()]
        table.add_row(baseline, *cells, "–", "–", style="dim")
    return table


def report_of(
    entries: Sequence[Entry],
    lede: str,
    facts: Mapping[str, str],
    commands: Mapping[str, str],
    scenes: str = "Unseen scenes",
    notes: Sequence[str] = (),
) -> Report:
    """The comparison, pictured on PICTURED_SCENES test scenes; the rest as in `Report`."""
    recipe, evaluation = entries[0].recipe, entries[0].evaluation
    few = recipe.evaluation.model_copy(update={"scenes": PICTURED_SCENES, "samples": 1})
    source = recipe.build_data()
    units = {(entry.recipe.views.scale, entry.recipe.views.scale_factor) for entry in entries}
    unlike = entries if len(units) > 1 or recipe.views.scale == "search" else entries[:1]
    pictured = [
        evaluation_samples(
            source,
            entry.recipe.views,
            few,
            views_of=entry.search,
            sampler=entry.windows or entry.recipe.build_view_sampler(),
            depths=entry is unlike[0],
        )[:PICTURED_SCENES]
        for entry in unlike
    ] * (len(entries) // len(unlike))
    samples = pictured[0]
    height, width = recipe.tree["data"]["image_size"]
    plugins = {name: v for entry in entries for name, (_, v) in entry.recipe.releases.items()}
    software = {"torch": torch.__version__, **plugins}
    gpu = torch.cuda.is_available()
    cores = f"CPU with {os.cpu_count()} cores ({platform.machine()})"
    device = torch.cuda.get_device_name() if gpu else cores
    threads = counted(torch.get_num_threads(), "thread")
    names = listed((entry.contender.name for entry in entries), most=3)
    judged = "beside" if entries[0].windows else "between"
    return Report(
        columns=evaluation.columns,
        title=f"{names}: {scenes.lower()}",
        lede=lede,
        scenes=scenes,
        notes=notes,
        meanings=[summary_of(p.component) for at, p in recipe.parts.items() if at[0] == "metrics"],
        commands=commands,
        contenders=[
            replace(entry.contender, samples=own)
            for entry, own in zip(entries, pictured, strict=True)
        ],
        baselines={n.replace("_", " ").capitalize(): evaluation.means(n) for n in BASELINES},
        samples=samples,
        facts={
            "Data": f"{recipe.tree['data']['type']}, {width} × {height} pixels",
            "Views": f"{recipe.views.inputs} inputs, judged on views {judged} them",
            **facts,
            "Machine": f"{device}, {threads}, {platform.system()}",
            "Software": ", ".join(f"{name} {version}" for name, version in software.items()),
        },
    )
