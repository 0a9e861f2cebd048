"""A Slurm array for a study: one task for each missing run."""

import shlex
import sys
from pathlib import Path

from qgs.io.files import write_text
from qgs_studies.plan import Plan


def write_script(plan: Plan, study: str, threads: int, device: str) -> Path:
    """OUT/slurm.sh: an array whose indices are the numbers of the missing runs.

    Slurm's signal before the end of a task's time lets the run save; a requeued task, or the same
    script submitted again, continues it.
    """
    missing = [n for n, run in enumerate(plan.runs) if not plan.done(run) and not run.ended]
    folder = plan.folder.resolve()
    command = [
        *(str(Path(sys.executable).with_name("qgs")), "study", _located(study)),
        *("--out", str(folder), "--threads", str(threads), "--device", device),
    ]
    name = plan.study.title.replace(" ", "-")
    lines = [
        "#!/bin/bash",
        f"#SBATCH --job-name={shlex.quote(name)}",
        f"#SBATCH --array={','.join(map(str, missing))}",
        f"#SBATCH --output={shlex.quote(str(folder / 'slurm-%A_%a.log'))}",
        "#SBATCH --ntasks=1",
        f"#SBATCH --cpus-per-task={threads}",
        *["#SBATCH --gpus-per-task=1"] * (device != "cpu"),
        "#SBATCH --time=24:00:00",
        "#SBATCH --signal=TERM@180",
        "#SBATCH --requeue",
        "# Change time, memory, partition and GPUs to those of your cluster. The table:",
        f"#   {shlex.join([*command[:5], '--workers', '0'])}",
        f"cd {shlex.quote(str(Path.cwd()))}",
        f"srun {shlex.join(command)} --only $SLURM_ARRAY_TASK_ID",
    ]
    script = plan.folder / "slurm.sh"
    write_text(script, "\n".join(lines) + "\n")
    return script


def _located(study: str) -> str:
    """The file's path where it is one, else the name under which it comes with qgs."""
    return str(Path(study).resolve()) if Path(study).is_file() else study
