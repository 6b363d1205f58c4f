#!/usr/bin/env bash
# infra/slurm on a real Slurm of one node: a cluster is launched, a job is given to it, a worker is taken away by Slurm and started again,
# and the model is that of one process. PLAT names the program. Everything started here ends here.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
packages=(slurmctld slurmd slurm-client munge)
dpkg -s "${packages[@]}" >/dev/null 2>&1 || { apt-get update -qq && apt-get install -qq --yes --no-install-recommends "${packages[@]}"; }

scratch=$(mktemp -d)
daemons=()
finish() {
    local code=$?
    scancel --user "$USER" >/dev/null 2>&1 || true
    ((code == 0)) || tail -n 20 "$scratch"/*.log "$scratch"/cluster/*.log || true
    sleep 1
    kill "${daemons[@]}" 2>/dev/null || true
    wait
    rm -rf "$scratch"
}
trap finish EXIT
export SLURM_CONF="$scratch/slurm.conf" USER="${USER:-root}"
node=$(hostname -s)
mkdir -p "$scratch"/{spool,state,munge}
chmod 755 "$scratch"
(umask 077; head -c 1024 /dev/urandom > "$scratch/munge/key")
cat > "$SLURM_CONF" <<CONF
ClusterName=plat
SlurmctldHost=$node
SlurmUser=root
AuthType=auth/munge
# Short, as a requeued job waits until its last credential is over.
AuthInfo=socket=$scratch/munge/socket,cred_expire=5
CryptoType=crypto/munge
StateSaveLocation=$scratch/state
SlurmdSpoolDir=$scratch/spool
SlurmctldPidFile=$scratch/slurmctld.pid
SlurmdPidFile=$scratch/slurmd.pid
SlurmctldPort=16817
SlurmdPort=16818
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
SchedulerParameters=batch_sched_delay=0,sched_min_interval=100000
ReturnToService=2
KillWait=20
NodeName=$node CPUs=4 RealMemory=8000 State=UNKNOWN
PartitionName=all Nodes=$node Default=YES State=UP MaxTime=1:00:00
CONF
munged --foreground --force --key-file "$scratch/munge/key" --socket "$scratch/munge/socket" --pid-file "$scratch/munge/pid" \
    --log-file "$scratch/munge/log" --seed-file "$scratch/munge/seed" >"$scratch/munged.log" 2>&1 &
daemons+=($!)
until [[ -S $scratch/munge/socket ]]; do sleep 0.1; kill -0 "${daemons[0]}"; done
slurmctld -D -c > "$scratch/slurmctld.log" 2>&1 &
daemons+=($!)
slurmd -D > "$scratch/slurmd.log" 2>&1 &
daemons+=($!)
within() {
    local seconds=$1; shift
    for ((i = 0; i < seconds * 5; i++)); do "$@" >/dev/null 2>&1 && return; sleep 0.2; done
    echo "not within $seconds s: $*" >&2
    return 1
}
is_idle() { [[ $(sinfo --noheader --format %t) == idle ]]; }
within 30 is_idle

"$PLAT" synth --out "$scratch/city" --area-km2 0.05 --views 24 --size 160x120 --quiet >/dev/null
plan=(--blocks tree --levels 1 --steps 1600 --backend cpu)
"$PLAT" train "$scratch/city" --out "$scratch/calm" --workers 1 "${plan[@]}" --quiet >/dev/null

export PLAT_CHECKPOINT_SECONDS=1
infra/slurm/launch.sh --home "$scratch/cluster" --workers 2 --plat "$PLAT" -- --mem 2G
client=("$PLAT" --config "$scratch/cluster/plat.toml")
within 60 "${client[@]}" jobs
"${client[@]}" submit "$scratch/city" --wait --out "$scratch/far" "${plan[@]}" > "$scratch/submit.log" 2>&1 &
submit=$!
# The array's first worker is taken away while it has a block in hand.
has_work() { "${client[@]}" status 1 --json --quiet | grep -q "\"worker\":\"$node-[0-9]*-1-0\""; }
within 60 has_work
array=$(squeue --noheader --name plat-worker --format %A --states all | sort -n | head -1)
scontrol requeue "${array}_1"
wait "$submit"
cmp "$scratch/calm/merged.ply" "$scratch/far/merged.ply"
grep -q "stopped after" "$scratch"/cluster/worker-*-1.log
is_back() { [[ $(scontrol show job "${array}_1") == *Restarts=1*  ]] && grep -q "worker $node-[0-9]*-1-1 for" "$scratch"/cluster/worker-*-1.log; }
within 60 is_back
echo "a worker of the array was requeued, left in time and came back; the model is that of one process"
