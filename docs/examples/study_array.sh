#!/bin/bash
# A study as an array, with a task for each run: sbatch --array=0-8 study_array.sh STUDY --out DIR
# `qgs study STUDY --out DIR --workers 0` says how many runs there are, and writes the table afterwards.
# Change time, memory and partition to those of your cluster; tasks save and requeue as in train_8_gpus.sh.
#SBATCH --job-name=study
#SBATCH --output=slurm-%A_%a.log
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=4
#SBATCH --gpus-per-task=1
#SBATCH --time=24:00:00
#SBATCH --signal=B:TERM@300
#SBATCH --requeue
#SBATCH --open-mode=append
trap 'kill -TERM "$job"; wait "$job"; scontrol requeue "$SLURM_JOB_ID"' TERM
qgs study "$@" --only "$SLURM_ARRAY_TASK_ID" & job=$!
wait "$job"
