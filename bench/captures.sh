#!/usr/bin/env bash
# The captures' lines of bench/results: each trained whole and as a tree of one level, three seeds, one thread, nothing pruned.
# Takes the folder of the captures, and the names of those to train (all where none is named). Ten minutes on one core.
set -euo pipefail
repository=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
# Lines of results name the command, so that its paths must not be those of one machine.
data=$(realpath --relative-to="$repository" "${1:?the folder of the captures}")
shift
cd "$repository"
plat=${PLAT:-target/release/plat}

# Name on the chart, folder, downscale, steps, splats, steps between looks.
while read -r scene folder downscale steps budget looks; do
    [[ $# == 0 || " $* " == *" $scene "* ]] || continue
    run() {
        "$plat" --quiet bench pareto "$data/$folder" --scene "$scene" --threads 1 --backend cpu --tolerance-db 0 --seed 0,1,2 \
            --downscale "$downscale" --out "out/captures/$scene" --fresh "$@" < /dev/null
    }
    run --label "plat whole" --blocks whole --steps "$steps" --budget "$budget" --eval-every "$looks"
    run --label "plat tree" --levels 1 --steps "$steps" --budget "$budget" --eval-every "$looks"
    [[ $scene != fox ]] || run --label "plat whole, more splats" --blocks whole --steps 1000 --budget 30000 --eval-every 50
done <<'CAPTURES'
fox fox/pinhole_270 1 400 14000 25
aerial_caliterra aerial_caliterra 4 2400 16000 100
street_lund street_lund 4 1500 6000 100
building_sceaux building_sceaux 4 500 5000 50
drive_kitti_odom_1 drive_kitti_odom_1 2 1200 30000 0
CAPTURES
