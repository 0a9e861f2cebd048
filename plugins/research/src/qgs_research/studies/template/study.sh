#!/bin/bash
# A study as a job array with a task for each missing run. To write the table, run the command with --workers 0 in place of --only.
# Set time, memory and partition for your cluster. A task saves when it is preempted and five minutes
# before its time ends. Slurm then starts it again, and it continues.
#SBATCH --array={array}
#SBATCH --job-name={name}
#SBATCH --output={log}
#SBATCH --ntasks=1
#SBATCH --cpus-per-task={cores}{gpu_line}
#SBATCH --time=24:00:00
#SBATCH --signal=B:TERM@300
#SBATCH --requeue
#SBATCH --open-mode=append
cd {folder} || exit
trap 'kill -TERM "$job"; wait "$job"; scontrol requeue "$SLURM_JOB_ID"' TERM
{command} --only "$SLURM_ARRAY_TASK_ID" & job=$!
wait "$job"
