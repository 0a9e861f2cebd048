"""Command `qgs slurm`: write Slurm jobs that save their training before the time limit."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from qgs.cli.options import Device
from qgs_research.studies.commands import StudyFile

app = typer.Typer(help="Write Slurm jobs that save a training in time and continue it later.")


# Unknown options are passed on to `qgs train`.
@app.command(context_settings={"ignore_unknown_options": True})
def train(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="RECIPE --out RUN ...", help="Arguments and options for `qgs train`."
        ),
    ],
    gpus: Annotated[int, typer.Option(min=1, help="Number of GPUs, all on one node.")] = 1,
) -> None:
    """Write RUN.slurm.sh, a Slurm job for `qgs train` with the given arguments."""
    from qgs.cli import app as qgs
    from qgs.evaluate.plan import read_index
    from qgs.recipe import resolve

    group: Any = typer.main.get_command(qgs)
    # Parse as `qgs train` does, so that errors appear now and not when the job starts.
    given = group.commands["train"].make_context("qgs train", [*words]).params
    recipe = resolve(given["recipe"], given["overrides"] or ())
    read_index(recipe.evaluation.index)
    recipe.build_data()
    recipe.training.scenes_per_batch(gpus)
    run = given["out"].resolve()
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={gpus}"]
    _write_job(
        run.with_name(f"{run.name}.slurm.sh"),
        [*launcher, "-m", "qgs", "train", *words, "--resume"],
        template="train.sh",
        name=run.name,
        log=run.with_name(f"{run.name}.slurm-%j.log"),
        cores=gpus * ((given["threads"] or 1) + recipe.training.workers),
        gpu_line="" if given["device"] == "cpu" else f"\n#SBATCH --gpus-per-node={gpus}",
    )


@app.command()
def study(
    file: StudyFile,
    out: Annotated[Path, typer.Option(help="Folder for the runs and results of the study.")],
    threads: Annotated[int, typer.Option(min=1, help="CPU threads per run.")] = 1,
    device: Device = "auto",
) -> None:
    """Write OUT/slurm.sh, a Slurm job array with one task for each missing run of a study."""
    from qgs_research.studies.plan import planned
    from qgs_research.studies.study import read_study

    plan = planned(read_study(file), out.resolve())
    missing = [
        str(number) for number, run in enumerate(plan.runs) if not plan.done(run) and not run.failed
    ]
    if not missing:
        raise ValueError(
            f"all runs in {out} are done or failed, so no job is needed; to write the tables, call "
            "`qgs study` with --workers 0"
        )
    words = ["study", file, "--out", str(plan.folder), "--threads", str(threads)]
    workers = max(recipe.training.workers for recipe in plan.recipes.values())
    _write_job(
        plan.folder / "slurm.sh",
        ["-m", "qgs", *words, "--device", device],
        template="study.sh",
        array=",".join(missing),
        name=plan.folder.name,
        log=plan.folder / "slurm-%A_%a.log",
        cores=threads + workers,
        gpu_line="" if device == "cpu" else "\n#SBATCH --gpus-per-task=1",
    )


def _write_job(
    script: Path, words: Sequence[str], *, template: str, name: str, log: Path, **values: Any
) -> None:
    """Fill a job template and write it to `script`.

    words: arguments after `python` on the job's command line. values: further fields of the
    template. The job runs in the current folder.
    """
    from qgs.files import write_text

    text = (Path(__file__).with_name("template") / template).read_text(encoding="utf-8")
    filled = text.format(
        name=shlex.quote(name),
        log=shlex.quote(str(log)),
        folder=shlex.quote(str(Path.cwd())),
        command=shlex.join([sys.executable, *words]),
        **values,
    )
    write_text(script, filled)
    typer.echo(f"wrote {script}; submit it with: sbatch {shlex.quote(str(script))}")
