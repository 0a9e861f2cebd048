"""Slurm jobs, of studies and of trainings, that save before their time is over and go on after."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from qgs.files import write_text
from qgs_research.studies.plan import Plan

COMMENT = "# Change time, memory, partition and GPUs to those of your cluster."


def write_job(
    script: Path, name: str, options: Sequence[str], command: str, stop: str, note: str = COMMENT
) -> None:
    """A script for sbatch that runs `command` in this folder, and requeues itself.

    options: of sbatch, such as "ntasks=1". stop: shell command that makes the process $job save
    and end; Slurm's signal, 5 minutes before the end of the job's time, runs it.
    """
    lines = [
        "#!/bin/bash",
        *(f"#SBATCH --{option}" for option in (f"job-name={shlex.quote(name)}", *options)),
        "#SBATCH --time=24:00:00",
        "#SBATCH --signal=B:TERM@300",
        "#SBATCH --requeue",
        "#SBATCH --open-mode=append",
        note,
        f"cd {shlex.quote(str(Path.cwd()))}",
        # Slurm requeues preempted jobs by itself, those whose time is over only on request.
        f'trap \'{stop}; wait "$job"; scontrol requeue "$SLURM_JOB_ID"\' TERM',
        # In the background: bash runs a trap only after a command in the foreground has ended.
        f"{command} & job=$!",
        'wait "$job"',
    ]
    write_text(script, "\n".join(lines) + "\n")


def write_training(out: Path, words: Sequence[str], processes: int, cpus: int, gpu: bool) -> Path:
    """OUT.slurm.sh: `qgs train` with `words` in that many processes of one machine, by torchrun.

    cpus: of each process. gpu: each has one.
    """
    script = out.absolute().with_name(f"{out.name}.slurm.sh")
    options = [
        f"output={shlex.quote(str(script.with_name(f'{out.name}.slurm-%j.log')))}",
        "nodes=1",
        "ntasks=1",
        f"cpus-per-task={processes * cpus}",
        *[f"gpus-per-node={processes}"] * gpu,
    ]
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    train = ["-m", "qgs", "train", *words, "--resume"]
    command = shlex.join([*launcher, f"--nproc-per-node={processes}", *train])
    # The trainings, not torchrun, which would kill them after 30 s, perhaps while they save.
    write_job(script, out.name, options, command, 'pkill -TERM -P "$job"')
    return script


def write_script(plan: Plan, study: str, threads: int, device: str) -> Path:
    """OUT/slurm.sh: an array whose indices are the numbers of the missing runs.

    A task saves and requeues itself before its time is over; the same script submitted again
    continues it too.
    """
    missing = [n for n, run in enumerate(plan.runs) if not plan.done(run) and not run.ended]
    folder = plan.folder.resolve()
    command = [
        *(str(Path(sys.executable).with_name("qgs")), "study", _located(study)),
        *("--out", str(folder), "--threads", str(threads), "--device", device),
    ]
    options = [
        f"array={','.join(map(str, missing))}",
        f"output={shlex.quote(str(folder / 'slurm-%A_%a.log'))}",
        "ntasks=1",
        f"cpus-per-task={threads}",
        *["gpus-per-task=1"] * (device != "cpu"),
    ]
    table = shlex.join([*command[:5], "--workers", "0"])
    script = plan.folder / "slurm.sh"
    write_job(
        script,
        plan.study.title.replace(" ", "-"),
        options,
        f"{shlex.join(command)} --only $SLURM_ARRAY_TASK_ID",
        'kill -TERM "$job"',
        f"{COMMENT} The table:\n#   {table}",
    )
    return script


def _located(study: str) -> str:
    """The file's path where it is one, else the name under which it comes with qgs."""
    return str(Path(study).resolve()) if Path(study).is_file() else study
