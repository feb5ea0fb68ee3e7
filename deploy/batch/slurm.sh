#!/bin/bash
# A run on one node of a Slurm cluster, which continues after its time limit, a preemption or the loss of its node.
# In the folder that is to contain runs/, with icrl-dist in the PATH (the arguments are those of `icrl-dist train`):
#
#     sbatch deploy/batch/slurm.sh demo --seed 3 --out runs/demo-3
#
# Two minutes before the time limit Slurm sends SIGUSR1 to this script (B:), which sends it to the run.  The run writes
# its checkpoint and ends with exit code 130, and the job is queued again.  `scancel` ends the run with a checkpoint
# too; `sbatch` with the same arguments continues it.
#
# The run is not started with srun, because srun sends a signal to all processes of the run, Ray's included.
#
#SBATCH --job-name=icrl-dist
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=16
#SBATCH --mem=32G
#SBATCH --time=24:00:00
#SBATCH --signal=B:USR1@120
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=%x-%j.log

cd "$SLURM_SUBMIT_DIR" || exit 2
icrl-dist train "$@" --resume-or-begin --actors "$SLURM_CPUS_PER_TASK" &
driver=$!
warned=
trap 'warned=1; kill -USR1 "$driver"' USR1
trap 'kill -TERM "$driver"' TERM
wait "$driver"
code=$?
while kill -0 "$driver" 2>/dev/null; do  # a signal ends `wait` before the run has ended
    wait "$driver"
    code=$?
done
if [ "$code" = 130 ] && [ -n "$warned" ]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
