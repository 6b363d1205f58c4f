#!/usr/bin/env bash
# Lines of bench/results/prune.jsonl: each capture trained as one block and pruned within 0.1 dB, one thread, seed 0.
# Takes the folder of the captures, and the names of those to prune (all where none is named). RESULTS is the folder of the lines. Ten minutes.
set -euo pipefail
repository=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
# Lines of results name the command, so that its paths must not be those of one machine.
data=$(realpath --relative-to="$repository" "${1:?the folder of the captures}")
shift
cd "$repository"
plat=${PLAT:-target/release/plat}

# Name on the chart, folder, downscale, steps, splats.
while read -r scene folder downscale steps budget; do
    [[ $# == 0 || " $* " == *" $scene "* ]] || continue
    "$plat" --quiet train "$data/$folder" --out "out/prune/$scene" --fresh --blocks whole --downscale "$downscale" --steps "$steps" \
        --budget "$budget" --threads 1 --backend cpu --tolerance-db 0 --eval-every 0 < /dev/null
    "$plat" --quiet bench prune "out/prune/$scene" "$data/$folder" --scene "$scene" --order energy --results "${RESULTS:-bench/results}" < /dev/null
done <<'CAPTURES'
aerial_caliterra aerial_caliterra 4 2400 16000
street_lund street_lund 4 1500 6000
building_sceaux building_sceaux 4 500 5000
drive_kitti_odom_1 drive_kitti_odom_1 2 1200 30000
fox fox/pinhole_270 1 400 28000
CAPTURES
