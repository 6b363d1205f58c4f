#!/usr/bin/env bash
# The streets' lines of bench/results: what eye-level photos of generated cities and of a drive gain with time; one thread, nothing pruned.
# Takes the names of those to train (all where none is named). SEED has the seeds (0,1,2) and STEPS the steps, both as lists, LIDAR "without",
# "with" or both (both), DETECTOR the ONNX file of a detector, CAPTURES the folder of drive_kitti_odom_1. Photos are kept in out/streets.
# All of it takes hours on one core; SEED=0 a third.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
plat=${PLAT:-target/release/plat}
captures=${CAPTURES:-../shared/data}
detector=(${DETECTOR:+--detector "$(realpath --relative-to=. "$DETECTOR")"})
common=(--seed "${SEED:-0,1,2}" --threads 1 --backend cpu --tolerance-db 0 --eval-every 0 "${detector[@]}" --fresh)
ran=
wanted() { local name=$1; shift; [[ $# == 0 || " $* " == *" $name "* ]] && ran=1; }

# Name, steps, splats, every how many views one is held out, options of synth.
while read -r name steps budget every options; do
    wanted "$name" "$@" || continue
    capture="out/streets/$name"
    # shellcheck disable=SC2086
    if ! grep -qs '"complete": *true' "$capture/manifest.json"; then
        "$plat" --quiet synth $options --size 480x270 --lidar --truth --out "$capture"
    fi
    for lidar in ${LIDAR:-without with}; do
        without=()
        [[ $lidar == with ]] || without=(--no-lidar)
        "$plat" --quiet bench pareto "$capture" --label "plat, $lidar lidar" --steps "${STEPS:-$steps}" --budget "$budget" \
            --test-every "$every" --depth "${common[@]}" "${without[@]}" --out "out/streets/$name-$lidar-lidar"
    done
done <<'STREETS'
thin_city 350,1400,5600 140000 4 --area-km2 0.1 --views 170
city_0.3 850,3400,13600 340000 8 --area-km2 0.3 --views 500
dense_5m 375,1500,6000 150000 8 --area-km2 0.05 --views 600 --aerial 0.05 --traffic light --spacing 5
dense_2m 12000 200000 8 --area-km2 0.05 --views 1200 --aerial 0.05 --traffic light --spacing 2
STREETS

if wanted drive_kitti_odom_1 "$@"; then
    "$plat" --quiet bench pareto "$captures/drive_kitti_odom_1" --label "plat whole, by steps" --steps "${STEPS:-300,1200,4800,19200}" \
        --budget 30000 --blocks whole --downscale 2 "${common[@]}" --out out/streets/kitti
fi
[[ $ran ]] || { echo "bench/streets.sh: no street has one of the names $*: see the list in this file" >&2; exit 2; }
