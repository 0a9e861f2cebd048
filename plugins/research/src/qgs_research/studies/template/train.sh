#!/bin/bash
# A training on GPUs of one node. Change time, memory, partition and GPUs to those of your cluster.
# Five minutes before its time is over, or when it is preempted, the job saves; Slurm then starts it again, and it goes on.
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
# The trainings, not torchrun, which would kill them after 30 s, perhaps while they save.
trap 'pkill -TERM -P "$job"; wait "$job"; scontrol requeue "$SLURM_JOB_ID"' TERM
# In the background: bash runs a trap only after a command in the foreground has ended.
{command} & job=$!
wait "$job"
