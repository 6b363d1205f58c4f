#!/usr/bin/env bash
# The streets' lines of bench/results: what eye-level photos of generated cities gain, three seeds, one thread, nothing pruned.
# Takes the names of those to train (all where none is named), and the ONNX file of a detector in DETECTOR, if one is there. Photos are kept in
# out/streets. On one core the thin city takes ten minutes; the others have not been run with three seeds yet.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
plat=${PLAT:-target/release/plat}
detector=(${DETECTOR:+--detector "$(realpath --relative-to=. "$DETECTOR")"})

# Name, steps, splats, every how many views one is held out, options of synth.
while read -r name steps budget every options; do
    [[ $# == 0 || " $* " == *" $name "* ]] || continue
    capture="out/streets/$name"
    # shellcheck disable=SC2086
    if ! grep -qs '"complete": *true' "$capture/manifest.json"; then
        "$plat" --quiet synth $options --size 480x270 --lidar --truth --out "$capture"
    fi
    for lidar in "without lidar" "with lidar"; do
        without=()
        [[ $lidar == "with lidar" ]] || without=(--no-lidar)
        "$plat" --quiet bench pareto "$capture" --scene "$name" --label "plat, $lidar" --seed 0,1,2 --threads 1 --tolerance-db 0 \
            --steps "$steps" --budget "$budget" --test-every "$every" --eval-every 0 --depth "${detector[@]}" --fresh "${without[@]}" \
            --out "out/streets/$name-${lidar// /-}"
    done
done <<'STREETS'
thin_city 1400 140000 4 --area-km2 0.1 --views 170
city_0.3 3400 340000 8 --area-km2 0.3 --views 500
dense_5m 6000 150000 8 --area-km2 0.05 --views 600 --aerial 0.05 --traffic light --spacing 5
dense_2m 12000 200000 8 --area-km2 0.05 --views 1200 --aerial 0.05 --traffic light --spacing 2
STREETS
