#!/bin/bash
# A training on 8 GPUs of one node: sbatch train_8_gpus.sh RECIPE --out RUN
# Change time, memory, partition and GPUs to those of your cluster. Five minutes before its time is over,
# or when it is preempted, the job saves; Slurm then starts it again, and it goes on.
#SBATCH --job-name=qgs
#SBATCH --output=slurm-%j.log
#SBATCH --ntasks=1
#SBATCH --nodes=1
#SBATCH --cpus-per-task=64
#SBATCH --gpus-per-node=8
#SBATCH --time=24:00:00
#SBATCH --signal=B:TERM@300
#SBATCH --requeue
#SBATCH --open-mode=append
# The trainings, not torchrun, which would kill them after 30 s, perhaps while they save.
trap 'pkill -TERM -P "$job"; wait "$job"; scontrol requeue "$SLURM_JOB_ID"' TERM
# In the background: bash runs a trap only after a command in the foreground has ended.
torchrun --standalone --nproc-per-node="${SLURM_GPUS_ON_NODE:-8}" -m qgs train "$@" --resume & job=$!
wait "$job"
