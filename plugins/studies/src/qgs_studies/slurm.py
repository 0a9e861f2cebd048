"""A Slurm array of workers for a study; Slurm schedules, the study's folder says who does what."""

import shlex
import sys
from pathlib import Path

from qgs.io.files import write_text
from qgs_studies.plan import Plan


def write_script(plan: Plan, study: str, missing: int, threads: int, device: str) -> Path:
    """OUT/slurm.sh: one task for each missing run, of which each makes the next free one.

    Slurm's signal before the end of a task's time lets the run save; a task that comes again, or
    the same script submitted again, goes on with it.
    """
    folder = plan.folder.resolve()
    command = [
        *(str(Path(sys.executable).with_name("qgs")), "study", _located(study)),
        *("--out", str(folder), "--workers", "1", "--runs", "1", "--threads", str(threads)),
        *("--device", device),
    ]
    name = plan.study.title.replace(" ", "-")
    lines = [
        "#!/bin/bash",
        f"#SBATCH --job-name={shlex.quote(name)}",
        f"#SBATCH --array=1-{max(missing, 1)}",
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
        f"srun {shlex.join(command)}",
    ]
    script = plan.folder / "slurm.sh"
    write_text(script, "\n".join(lines) + "\n")
    return script


def _located(study: str) -> str:
    """The file's path where it is one, else the name under which it comes with qgs."""
    return str(Path(study).resolve()) if Path(study).is_file() else study
