"""`qgs slurm`: jobs that save before their time is over and go on after."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from qgs.cli.options import Device

app = typer.Typer(help="Write jobs for Slurm that save before their time ends, and go on.")

COMMENT = "# Change time, memory, partition and GPUs to those of your cluster."


# Slurm requeues preempted jobs by itself, those whose time is over only on request. The command
# runs in the background: bash runs a trap only after a command in the foreground has ended.
_JOB = """#!/bin/bash
#SBATCH --job-name={name}
#SBATCH --output={log}
#SBATCH --ntasks=1
{options}
#SBATCH --time=24:00:00
#SBATCH --signal=B:TERM@300
#SBATCH --requeue
#SBATCH --open-mode=append
{note}
cd {folder}
trap '{stop}; wait "$job"; scontrol requeue "$SLURM_JOB_ID"' TERM
{command} & job=$!
wait "$job"
"""


# Options that this command does not have are those of `qgs train`.
@app.command(context_settings={"ignore_unknown_options": True})
def train(
    words: Annotated[
        list[str], typer.Argument(metavar="RECIPE --out RUN ...", help="As `qgs train` takes them.")
    ],
    gpus: Annotated[int, typer.Option(min=1, help="GPUs of one node, a process each.")] = 1,
) -> None:
    """Write RUN.slurm.sh, which trains on the GPUs of a node. RECIPE and options: `qgs train`."""
    from qgs.cli import app as qgs
    from qgs.evaluate.protocol import index_of
    from qgs.recipe import resolve

    group: Any = typer.main.get_command(qgs)
    # Parsed as `qgs train` does: what it would refuse is refused now, not when the job starts.
    command = group.get_command(None, "train")
    given = command.make_context("qgs train", [*words]).params
    recipe = resolve(given["recipe"], given["overrides"] or ())
    # A missing index would end the job only after the training.
    index_of(recipe)
    recipe.training.scenes_per_batch(gpus)
    run = given["out"].absolute()
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    train = ["-m", "qgs", "train", *words, "--resume"]
    cores = gpus * ((given["threads"] or 1) + recipe.training.workers)
    options = ["nodes=1", f"cpus-per-task={cores}"]
    if given["device"] != "cpu":
        options.append(f"gpus-per-node={gpus}")
    _write_job(
        run.with_name(f"{run.name}.slurm.sh"),
        run.name,
        log=run.with_name(f"{run.name}.slurm-%j.log"),
        options=options,
        command=shlex.join([*launcher, f"--nproc-per-node={gpus}", *train]),
        # The trainings, not torchrun, which would kill them after 30 s, perhaps while they save.
        stop='pkill -TERM -P "$job"',
    )


@app.command()
def study(
    file: Annotated[
        str, typer.Argument(metavar="STUDY", help="Study file, or one that comes with qgs.")
    ],
    out: Annotated[Path, typer.Option(help="Folder of the study.")],
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of a run.")] = 1,
    device: Device = "auto",
) -> None:
    """Write OUT/slurm.sh, an array with a task for each missing run of a study."""
    from qgs_research.studies.plan import planned
    from qgs_research.studies.runs import write_plan
    from qgs_research.studies.study import read_study

    plan = planned(read_study(file), out)
    write_plan(plan)
    missing = [n for n, run in enumerate(plan.runs) if not plan.done(run) and not run.ended]
    folder = out.resolve()
    # A name stays one: where qgs is installed on the cluster, its study lies elsewhere.
    located = str(Path(file).resolve()) if Path(file).is_file() else file
    qgs = str(Path(sys.executable).with_name("qgs"))
    table = [qgs, "study", located, "--out", str(folder)]
    run = [*table, "--threads", str(threads), "--device", device]
    options = [f"array={','.join(map(str, missing))}", f"cpus-per-task={threads}"]
    if device != "cpu":
        options.append("gpus-per-task=1")
    _write_job(
        out / "slurm.sh",
        plan.study.title.replace(" ", "-"),
        log=folder / "slurm-%A_%a.log",
        options=options,
        command=f"{shlex.join(run)} --only $SLURM_ARRAY_TASK_ID",
        stop='kill -TERM "$job"',
        note=f"{COMMENT} The table:\n#   {shlex.join([*table, '--workers', '0'])}",
    )


def _write_job(
    script: Path, name: str, *, log: Path, options: Sequence[str], note: str = COMMENT, **words: str
) -> None:
    """Write a script for sbatch that runs a command in this folder, and requeues itself.

    options: of sbatch, such as "nodes=1". words: of `_JOB`: command, and stop, a shell command that
    makes the process $job save and end; Slurm's signal, 5 minutes before the end of the job's time,
    runs it.
    """
    from qgs.files import write_text

    text = _JOB.format(
        name=shlex.quote(name),
        log=shlex.quote(str(log)),
        options="\n".join(f"#SBATCH --{option}" for option in options),
        note=note,
        folder=shlex.quote(str(Path.cwd())),
        **words,
    )
    write_text(script, text)
    typer.echo(f"wrote {script}; submit it with: sbatch {script}")
