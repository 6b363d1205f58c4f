#!/usr/bin/env bash
# Starts a cluster of plat as Slurm jobs: one coordinator, and an array of workers.
#
#     infra/slurm/launch.sh --home FOLDER --workers N [--store URL] [--plat FILE] [-- options of sbatch for the workers]
#     plat --config FOLDER/plat.toml submit CAPTURE --wait --out MODEL
#     scancel --name plat-worker,plat-coordinator --user "$USER"
#
# FOLDER is on a file system that all nodes share, readable by you alone. It holds certificates and token and, without --store, all
# photos, results and state. Options after -- apply to the workers (--partition gpu --gres gpu:1 --array-limit ...). Slurm places the
# workers, preempts them and restarts them.
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
# The coordinator may run on any node, and move to another one.
sinfo --noheader --Node --format %N | sort -u | SECRETS="$home/secrets" SHARED="$home" xargs "$here/../cluster/certificates.sh"
coordinator=$(sbatch --parsable --output "$home/coordinator-%j.log" "$here/coordinator.sbatch")
# A worker would wait for its coordinator, but starting it earlier would only occupy its node.
array=$(sbatch --parsable --output "$home/worker-%A-%a.log" --dependency "after:$coordinator" --array "1-$workers" "$@" "$here/worker.sbatch")
echo "coordinator $coordinator, workers $array"
echo "plat --config $home/plat.toml jobs"
