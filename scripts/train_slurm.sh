#!/usr/bin/env bash
# A run on Slurm, one process per GPU, on one or several nodes. Before the time limit, or when the job is preempted, the
# run writes a checkpoint and exits with status 75. The job is then queued again and resumes.
#
#     sbatch scripts/train_slurm.sh configs/default.yaml run_dir=/shared/runs/droid
#
# run_dir must be readable on the first node. With checkpoint.remote the run can resume on any machine.
#
# A sweep is a job array: task N uses the overrides in line N of the file GRID (such as examples/sweeps/grid.txt). Its
# run_dir is GRID/N, without the extension of GRID.
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
# ntasks-per-node and gpus-per-node must be equal. --signal: sent to every process 300 seconds before the time limit.
set -euo pipefail

readonly STOPPED=75 # exit status of a run that stopped on request and can resume

if [[ -n ${SLURM_ARRAY_TASK_ID:-} ]]; then
  read -ra overrides < <(sed -n "${SLURM_ARRAY_TASK_ID}p" "${GRID:?names the file of overrides}") || true  # `read` fails if the last line has no newline
  : "${overrides:?$GRID has no line $SLURM_ARRAY_TASK_ID}"
  set -- "$@" "${overrides[@]}" "run_dir=${GRID%.*}/$SLURM_ARRAY_TASK_ID"
fi

MASTER_ADDR="$(scontrol show hostnames "$SLURM_JOB_NODELIST" | sed -n 1p)"  # not `head`, which would close the pipe early
MASTER_PORT="$((20000 + SLURM_JOB_ID % 20000))"
WORLD_SIZE="$SLURM_NTASKS"
export MASTER_ADDR MASTER_PORT WORLD_SIZE

# srun sets the rank of each process. If a process fails, srun ends the other processes, which would wait for it.
status=0
srun --kill-on-bad-exit=1 bash -c 'RANK="$SLURM_PROCID" LOCAL_RANK="$SLURM_LOCALID" exec vjepa2-ac train "$@"' train "$@" ||
  status=$?

if [[ $status -eq $STOPPED ]]; then
  scontrol requeue "$SLURM_JOB_ID"
  exit 0
fi
exit "$status"
