#!/usr/bin/env bash
# The cities' lines of bench/results: what a km² costs as a city grows, and what its blocks' faces cost.
# Takes a capture of 0.3, 0.6 and 1.2 km² with STEPS (10) training steps a view on one thread, one after the other. On two cores about a quarter
# of an hour for the photos (kept in out/cities) and half an hour for training; no more than the second core may be at work meanwhile, as CPU
# seconds are compared.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
plat=${PLAT:-target/release/plat}

# Area in km², photos, levels: blocks of about the same edge.
while read -r area views levels; do
    city="out/cities/$area"
    if ! grep -qs '"complete": *true' "$city/manifest.json"; then
        "$plat" --quiet synth --area-km2 "$area" --views "$views" --size 480x270 --out "$city"
    fi
    model="$city-model"
    rm -rf "$model"
    "$plat" --quiet bench pareto "$city" --label "plat tree" --scene "city, $area km²" \
        --levels "$levels" --steps $((${STEPS:-10} * views)) --no-lidar --eval-every 0 --threads 1 --backend cpu --fresh --out "$model"
    "$plat" --quiet bench tree "$model" "$city" --scene "city, $area km²"
done <<'CITIES'
0.3 500 2
0.6 1000 2
1.2 2000 3
CITIES
