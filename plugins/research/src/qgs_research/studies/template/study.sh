#!/bin/bash
# A study as an array, with a task for each run that is missing; the same with --workers 0 in place of --only writes the table.
# Change time, memory and partition to those of your cluster. Five minutes before its time is over,
# or when it is preempted, a task saves; Slurm then starts it again, and it goes on.
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
