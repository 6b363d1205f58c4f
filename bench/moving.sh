#!/usr/bin/env bash
# Lines of bench/results/moving: streets with objects that move, modelled and left out, one thread, nothing pruned. `moving_psnr` is of the
# pixels within their boxes, `psnr` of all others. Makes the street in out/moving if it is not there; takes the folder of the captures for
# drive_dgp_scene_01 too. SEED has the seeds (0). RESULTS is the folder of the lines. A quarter of an hour.
# ONLY=layouts measures the four layouts of Street Detection Gaussians with traffic instead, smaller ones: ten minutes.
# ONLY=people measures people who walk, as people and as rigid objects: filmed by cameras on posts, and from a car. Half an hour.
set -euo pipefail
repository=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
# Lines of results name the command, so that its paths must not be those of one machine.
captures=${1:+$(realpath --relative-to="$repository" "$1")}
cd "$repository"
plat=${PLAT:-target/release/plat}
street=out/moving/street
common=(--seed "${SEED:-0}" --blocks whole --threads 1 --backend cpu --tolerance-db 0 --eval-every 0 --fresh --results "${RESULTS:-bench/results/moving}")

if [[ ${ONLY:-} == layouts ]]; then
    for layout in curved-corridor alley winding deck; do
        street=out/moving/$layout
        if ! grep -qs '"complete": *true' "$street/manifest.json"; then
            "$plat" --quiet synth --area-km2 0.03 --layout "$layout" --views 480 --spacing 2 --aerial 0.1 --traffic medium --size 320x180 \
                --out "$street"
        fi
        for objects in without with; do
            modelled=()
            [[ $objects == without ]] || modelled=(--objects)
            "$plat" --quiet bench pareto "$street" --label "plat, $objects objects" --steps 2500 --budget 20000 "${common[@]}" "${modelled[@]}" \
                --out "out/moving/$layout-$objects"
        done
    done
    exit
fi
if [[ ${ONLY:-} == people ]]; then
    while read -r street options; do
        at=out/moving/$street
        if ! grep -qs '"complete": *true' "$at/manifest.json"; then
            # shellcheck disable=SC2086 # several options
            "$plat" --quiet synth --area-km2 0.02 --seed 3 --layout alley --traffic heavy $options --out "$at" </dev/null
        fi
        # An object of a class that nobody knows is rigid.
        rm -rf "$at-rigid"
        cp -r "$at" "$at-rigid"
        sed -i -E 's/"class": ?"person"/"class":"statue"/' "$at-rigid/tracks.json"
        for people in swing rigid; do
            capture=$at
            [[ $people == swing ]] || capture=$at-rigid
            "$plat" --quiet bench pareto "$capture" --label "plat, people $people" --steps 3000 --budget 15000 --objects "${common[@]}" \
                --out "out/moving/$street-$people" </dev/null
        done
    done <<'STREETS'
film --watch=-29,42,7 --film 3 --views 360 --size 960x540
drive --spacing 0.4 --aerial 0 --views 420 --size 640x360
STREETS
    exit
fi
if ! grep -qs '"complete": *true' "$street/manifest.json"; then
    "$plat" --quiet synth --area-km2 0.02 --views 640 --spacing 2 --aerial 0.1 --traffic medium --size 640x360 --out "$street"
fi
for objects in without with; do
    modelled=()
    [[ $objects == without ]] || modelled=(--objects)
    "$plat" --quiet bench pareto "$street" --label "plat, $objects objects" --steps 6000 --budget 40000 \
        "${common[@]}" "${modelled[@]}" --out "out/moving/$objects"
    if [[ -d $captures/drive_dgp_scene_01 ]]; then
        "$plat" --quiet bench pareto "$captures/drive_dgp_scene_01" --label "plat, $objects objects" --steps 2000 --budget 40000 --downscale 2 \
            "${common[@]}" "${modelled[@]}" --out "out/moving/dgp-$objects"
    fi
done
