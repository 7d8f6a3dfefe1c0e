#!/bin/bash
# A study as an array of SLURM jobs, without Dask: sbatch --array=1-20 slurm_array.sh study.toml
#SBATCH --job-name=beltrami
#SBATCH --cpus-per-task=4
#SBATCH --mem=16G
#SBATCH --time=04:00:00
#SBATCH --output=%x_%A_%a.out

# Task K of N does every N-th job of the study, from the K-th. Submitted again it does what is not done yet.
# For summaries add one for each task: --summary "part-$SLURM_ARRAY_TASK_ID.csv".
beltrami batch "$@" --resume --part "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT" \
  --threads "${SLURM_CPUS_PER_TASK:-1}"
