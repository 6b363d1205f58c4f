#!/usr/bin/env bash
# What browsers that follow a training cost it: CPU seconds of the threads that serve (and coordinate), and of all, without and
# with ten followers by turns. Threads are told apart by their names in /proc (Linux). Takes the folder of a capture; appends a line
# to RESULTS (bench/results/serve/followers.jsonl) for each run. STEPS (6000) is about half a minute on one core; PAIRS (2) are the pairs of runs.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
plat=${PLAT:-target/release/plat}
capture=${1:?the folder of a capture}
results=${RESULTS:-bench/results/serve/followers.jsonl}
out=out/followers
mkdir -p "$(dirname "$results")"
port=${PORT:-8931}
end_jobs() {
    local started
    mapfile -t started < <(jobs -p)
    [[ ${#started[@]} == 0 ]] || kill "${started[@]}" 2>/dev/null || true
}
trap end_jobs EXIT

# Clock ticks in a stat file of /proc: of a thread, or of a process with the threads that have ended.
ticks_of() {
    local fields
    fields=$(<"$1")
    read -r -a fields <<<"${fields##*) }"
    echo $((fields[11] + fields[12]))
}
# Clock ticks of a process's threads of tokio, which serve and coordinate.
serving_ticks() {
    local task sum=0
    for task in /proc/"$1"/task/*; do
        [[ $(<"$task/comm") == tokio* ]] || continue
        sum=$((sum + $(ticks_of "$task/stat")))
    done
    echo "$sum"
}
seconds() { awk -v ticks="$1" -v hertz="$(getconf CLK_TCK)" 'BEGIN { printf "%.2f", ticks / hertz }'; }

run() {
    local followers=$1 training tries n serving all
    rm -rf "$out"
    "$plat" --quiet train "$capture" --downscale 4 --steps "${STEPS:-6000}" --budget 16000 --levels 1 --threads 1 --backend cpu \
        --serve="127.0.0.1:$port" --out "$out" >/dev/null 2>&1 &
    training=$!
    for ((tries = 0; tries < 100; tries++)); do
        curl -s -o /dev/null "http://127.0.0.1:$port/api/jobs" && break
        sleep 0.1
    done
    ((tries < 100)) || { echo "bench/followers.sh: the training does not serve: see plat train $capture --serve" >&2; exit 1; }
    for ((n = 0; n < followers; n++)); do curl -sN "http://127.0.0.1:$port/api/events" >/dev/null & done
    # Serving goes on after training, until the process is told to end.
    until [[ -s $out/report.json ]]; do
        kill -0 "$training" 2>/dev/null || { echo "bench/followers.sh: the training ended early" >&2; exit 1; }
        sleep 0.2
    done
    serving=$(serving_ticks "$training")
    all=$(ticks_of "/proc/$training/stat")
    end_jobs
    wait 2>/dev/null || true
    printf '{"commit":"%s","followers":%d,"serving_cpu_seconds":%s,"cpu_seconds":%s,"command":"bench/followers.sh"}\n' \
        "$(sed -n 's/.*"commit": *"\([^"]*\)".*/\1/p' "$out/report.json" | head -1)" "$followers" "$(seconds "$serving")" "$(seconds "$all")" | tee -a "$results"
}

for ((pair = 0; pair < ${PAIRS:-2}; pair++)); do
    run 0
    run 10
done
