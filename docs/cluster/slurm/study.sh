#!/bin/bash
# Searches that share one study:   sbatch study.sh NAME [CONFIG] --vary KEY=VALUES [--trials N] [--set KEY=VALUE]...
# Its runs are runs/NAME-0000, ... where sbatch was called, its results in runs/NAME. docs/cluster.md explains each part.
#SBATCH --array=1-4                # EDIT: searches at a time, on any nodes
#SBATCH --cpus-per-task=4          # EDIT: cores of one run
#SBATCH --mem=8G                   # shared memory counts
#SBATCH --time=12:00:00
#SBATCH --signal=INT@120           # two minutes before the end its run is given up ...
#SBATCH --requeue                  # ... and the job queues again, here and after a preemption
#SBATCH --open-mode=append
#SBATCH --output=%x-%A_%a.log

PATH=$HOME/caraware/bin:$PATH      # EDIT: the PREFIX of `make install`; nothing with a container
CONTAINER=()                       # or (apptainer exec --nv "$HOME/caraware.sif")
RUNS=$SLURM_SUBMIT_DIR/runs        # on a file system that all nodes have

export PATH
srun --cpus-per-task="$SLURM_CPUS_PER_TASK" "${CONTAINER[@]}" caraware study "$@" --runs "$RUNS"
status=$?

# 130: the search was interrupted, and goes on when the job starts again.
[ "$status" -eq 130 ] && scontrol requeue "$SLURM_JOB_ID"
exit "$status"
