#!/usr/bin/env bash
# A run on Slurm, one process for each GPU, on one node or many. Before its time is up, or when the job is preempted, the
# run writes a checkpoint and ends with status 75; the job then queues again and goes on where it stood.
#
#     sbatch scripts/train_slurm.sh configs/default.yaml run_dir=/shared/runs/droid
#
# run_dir must be seen by the first node; checkpoint.remote makes any other machine able to go on.
#
# A sweep is an array: task N adds the overrides in line N of the file GRID (such as examples/sweeps/grid.txt), and trains
# in the folder N of one beside that file.
#
#     GRID=/shared/sweep.txt sbatch --array=1-4 scripts/train_slurm.sh configs/default.yaml
#SBATCH --job-name=vjepa2-ac
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=1
#SBATCH --gpus-per-node=1
#SBATCH --cpus-per-task=12
#SBATCH --time=24:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=USR1@300
# ntasks-per-node and gpus-per-node: the same number. --signal: to every process, 300 seconds before the end.
set -euo pipefail

readonly STOPPED=75 # the run was asked to stop, and can go on

if [[ -n ${SLURM_ARRAY_TASK_ID:-} ]]; then
  read -ra overrides < <(sed -n "${SLURM_ARRAY_TASK_ID}p" "${GRID:?names the file of overrides}") || true  # a last line may lack its end
  : "${overrides:?$GRID has no line $SLURM_ARRAY_TASK_ID}"
  set -- "$@" "${overrides[@]}" "run_dir=${GRID%.*}/$SLURM_ARRAY_TASK_ID"
fi

MASTER_ADDR="$(scontrol show hostnames "$SLURM_JOB_NODELIST" | sed -n 1p)"  # reads to the end: `head` would leave, and break the pipe
MASTER_PORT="$((20000 + SLURM_JOB_ID % 20000))"
WORLD_SIZE="$SLURM_NTASKS"
export MASTER_ADDR MASTER_PORT WORLD_SIZE

# A process learns its place from srun. When one fails the others are ended, too: they would wait for it.
status=0
srun --kill-on-bad-exit=1 bash -c 'RANK="$SLURM_PROCID" LOCAL_RANK="$SLURM_LOCALID" exec vjepa2-ac train "$@"' train "$@" ||
  status=$?

if [[ $status -eq $STOPPED ]]; then
  scontrol requeue "$SLURM_JOB_ID"
  exit 0
fi
exit "$status"
