#!/bin/bash
# A training on the GPUs of one node. Set time, memory, partition and GPUs for your cluster.
# The job saves when it is preempted and five minutes before its time ends. Slurm then starts it again, and it continues.
#SBATCH --job-name={name}
#SBATCH --output={log}
#SBATCH --ntasks=1
#SBATCH --nodes=1
#SBATCH --cpus-per-task={cores}{gpu_line}
#SBATCH --time=24:00:00
#SBATCH --signal=B:TERM@300
#SBATCH --requeue
#SBATCH --open-mode=append
cd {folder} || exit
# Signal the trainings, not torchrun: it would kill them after 30 s, perhaps while they save.
trap 'pkill -TERM -P "$job"; wait "$job"; scontrol requeue "$SLURM_JOB_ID"' TERM
# Run in the background, because bash runs a trap only after a foreground command has ended.
{command} & job=$!
wait "$job"
