#!/bin/bash
#SBATCH --job-name=locus
#SBATCH --output=./runs/locus.slurm-%j.log
#SBATCH --ntasks=1
#SBATCH --nodes=1
#SBATCH --cpus-per-task=64
#SBATCH --gpus-per-node=8
#SBATCH --time=24:00:00
#SBATCH --signal=B:TERM@300
#SBATCH --requeue
#SBATCH --open-mode=append
# Change time, memory, partition and GPUs to those of your cluster.
cd .
trap 'pkill -TERM -P "$job"; wait "$job"; scontrol requeue "$SLURM_JOB_ID"' TERM
python -m torch.distributed.run --standalone --nproc-per-node=8 -m qgs train locus/re10k.yaml --out runs/locus --set training.workers=7 --resume & job=$!
wait "$job"
