#!/bin/bash
# One policy, learnt by the ranks of several nodes:   sbatch ranks.sh [CONFIG] [--envs N] [--set KEY=VALUE]...
# Their directories are runs/NAME, runs/NAME-rank1, ... where sbatch was called. docs/cluster.md explains each part.
#SBATCH --job-name=ranks
#SBATCH --nodes=2                  # EDIT
#SBATCH --ntasks-per-node=1        # one torchrun on each node
#SBATCH --cpus-per-task=16         # EDIT: cores of a node, which its ranks share
#SBATCH --mem=32G                  # of a node; shared memory counts
#SBATCH --time=12:00:00
#SBATCH --signal=TERM@120          # two minutes before the end all ranks write checkpoints and reports ...
#SBATCH --requeue                  # ... and the job queues again, here and after a preemption
#SBATCH --open-mode=append
#SBATCH --output=%x-%j.log
##SBATCH --gpus-per-node=4         # with RANKS_PER_NODE=4 and: sbatch ranks.sh town --set 'trainer.device="auto"'

PATH=$HOME/caraware/bin:$PATH      # EDIT: the PREFIX of `make install`; nothing with a container
CONTAINER=()                       # or (apptainer exec --nv "$HOME/caraware.sif")
RUNS=$SLURM_SUBMIT_DIR/runs        # on a file system that all nodes have
NAME=$SLURM_JOB_NAME
RANKS_PER_NODE=1                   # as many as GPUs

export PATH
CARAWARE_RANKS_SECRET=$(od -An -N16 -tx1 /dev/urandom | tr -d ' ')
export CARAWARE_RANKS_SECRET
head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
port=$((20000 + SLURM_JOB_ID % 10000))
if [ -e "$RUNS/$NAME/run.json" ]; then
    arguments=(--resume "$NAME")
else
    arguments=("$@" --name "$NAME")
fi

written() { stat -c %y "$RUNS/$NAME/report.json" 2> /dev/null; }
before=$(written)
srun --cpus-per-task="$SLURM_CPUS_PER_TASK" "${CONTAINER[@]}" \
    torchrun --nnodes "$SLURM_NNODES" --nproc-per-node "$RANKS_PER_NODE" --rdzv-id "$SLURM_JOB_ID" \
    --rdzv-backend c10d --rdzv-endpoint "$head:$port" \
    -m caraware.parallel "${arguments[@]}" --runs "$RUNS"
status=$?

# A new report says that the run was interrupted: it continues when the job starts again. (torchrun's status is 1 in any case.)
if [ "$(written)" != "$before" ] && grep -q '"result": "interrupted"' "$RUNS/$NAME/report.json"; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$status"
