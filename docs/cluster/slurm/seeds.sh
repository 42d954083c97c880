#!/bin/bash
# One run for each seed:   sbatch seeds.sh [CONFIG] [--set KEY=VALUE]...
# Their directories are runs/seed-1, runs/seed-2, ... where sbatch was called. docs/cluster.md explains each part.
#SBATCH --array=1-8                # EDIT: the seeds
#SBATCH --cpus-per-task=4          # EDIT: cores of one run; below, --gpus-per-task for a GPU
#SBATCH --mem=8G                   # shared memory counts
#SBATCH --time=12:00:00
#SBATCH --signal=TERM@120          # two minutes before the end the run writes its checkpoint and report ...
#SBATCH --requeue                  # ... and the job queues again, here and after a preemption
#SBATCH --open-mode=append
#SBATCH --output=%x-%A_%a.log
##SBATCH --gpus-per-task=1         # with: sbatch seeds.sh town --set 'trainer.device="auto"'

PATH=$HOME/caraware/bin:$PATH      # EDIT: the PREFIX of `make install`; nothing with a container
CONTAINER=()                       # or (apptainer exec --nv "$HOME/caraware.sif")
RUNS=$SLURM_SUBMIT_DIR/runs        # on a file system that all nodes have

export PATH
name=seed-$SLURM_ARRAY_TASK_ID
if [ -e "$RUNS/$name/run.json" ]; then
    arguments=(--resume "$name")
else
    arguments=("$@" --name "$name" --set "run.seed=$SLURM_ARRAY_TASK_ID")
fi

srun --cpus-per-task="$SLURM_CPUS_PER_TASK" "${CONTAINER[@]}" \
    caraware train "${arguments[@]}" --runs "$RUNS" --quiet
status=$?

# 130: the run was interrupted, and continues when the job starts again.
[ "$status" -eq 130 ] && scontrol requeue "$SLURM_JOB_ID"
exit "$status"
