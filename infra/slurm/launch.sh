#!/usr/bin/env bash
# Starts a cluster of plat as Slurm jobs: one coordinator, and an array of workers.
#
#     infra/slurm/launch.sh --home FOLDER --workers N [--store URL] [--plat FILE] [-- options of sbatch for the workers]
#     plat --config FOLDER/plat.toml submit CAPTURE --wait --out MODEL
#     scancel --name plat-worker,plat-coordinator --user "$USER"
#
# FOLDER is the cluster's: on a file system that all nodes have, readable by you alone. It holds what the parts prove themselves by and,
# without --store, all photos, results and state. Options after -- are the workers' (--partition gpu --gres gpu:1 --array-limit ...).
# Where workers run, and when they are preempted and started again, is Slurm's business.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
usage() { sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//p}' "${BASH_SOURCE[0]}" >&2; exit 2; }

home="" workers="" store="" plat=plat
while (($#)); do
    case $1 in
        --home) home=${2:?}; shift 2 ;;
        --workers) workers=${2:?}; shift 2 ;;
        --store) store=${2:?}; shift 2 ;;
        --plat) plat=${2:?}; shift 2 ;;
        --) shift; break ;;
        *) usage ;;
    esac
done
[[ -n $home && $workers =~ ^[1-9][0-9]*$ ]] || usage
plat=$(command -v "$plat") || { echo "$plat: is not to be found; give --plat the program" >&2; exit 2; }
mkdir -p "$home/secrets"
chmod 700 "$home" "$home/secrets"
home=$(cd "$home" && pwd)

plat=$(readlink -f "$plat")
export PLAT_HOME="$home" PLAT_STORE="${store:-file://$home/store}" PLAT_PROGRAM="$plat"
# The coordinator may come to any node, and again to another one.
sinfo --noheader --Node --format %N | sort -u | SECRETS="$home/secrets" SHARED="$home" xargs "$here/../cluster/certificates.sh"
coordinator=$(sbatch --parsable --output "$home/coordinator-%j.log" "$here/coordinator.sbatch")
# A worker waits for its coordinator, whenever that comes; it must not come before, as it would only hold its node.
array=$(sbatch --parsable --output "$home/worker-%A-%a.log" --dependency "after:$coordinator" --array "1-$workers" "$@" "$here/worker.sbatch")
echo "coordinator $coordinator, workers $array"
echo "plat --config $home/plat.toml jobs"
