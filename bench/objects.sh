#!/usr/bin/env bash
# Lines of bench/results/prune.jsonl with what detectors find, and bench/results/prune.svg: a generated street with traffic and two real ones,
# pruned to a half, a quarter and a tenth of their splats: the generated one by every order, the real ones by plain and by detection-aware
# pruning, without and with recoveries that ask the detector. Zones are those of YOLOX-nano; FastestDet only judges. Makes the generated street in out/objects if it is not there. Takes the folder of the captures and detectors, and the names of those to prune (all where none is
# named). RESULTS is the folder of the lines. Over an hour.
set -euo pipefail
repository=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
# Lines of results name the command, so that its paths must not be those of one machine.
data=$(realpath --relative-to="$repository" "${1:?the folder of the captures}")
shift
cd "$repository"
plat=${PLAT:-target/release/plat}
results=${RESULTS:-bench/results}
street=out/objects/street

if ! grep -qs '"complete": *true' "$street/manifest.json"; then
    "$plat" --quiet synth --area-km2 0.02 --views 640 --spacing 2 --aerial 0.1 --traffic medium --size 640x360 --out "$street"
fi
# Name on the chart, capture, downscale, every how many views one is held out, steps, splats, orders beside the detection-aware one.
while read -r scene capture downscale every steps budget orders; do
    [[ $# == 0 || " $* " == *" $scene "* ]] || continue
    "$plat" --quiet train "$capture" --out "out/objects/model-$scene" --fresh --blocks whole --downscale "$downscale" --test-every "$every" \
        --steps "$steps" --budget "$budget" --threads 1 --backend cpu --tolerance-db 0 --eval-every 0 < /dev/null
    # shellcheck disable=SC2086 # no orders are all
    "$plat" --quiet bench prune $orders "out/objects/model-$scene" "$capture" --scene "$scene" --tolerance-db 0 --keep 0.5,0.25,0.1 --results "$results" \
        --detector "$data/detectors/yolox_nano_416.onnx" --aligned-weight 0.003 --judge "$data/detectors/yolox_nano_416.onnx" \
        --judge "$data/detectors/fastestdet_352.onnx" < /dev/null
done <<CAPTURES
objects $street 1 8 6000 40000
street_lund $data/street_lund 1 4 3000 20000 --order energy
drive_dgp_scene_01 $data/drive_dgp_scene_01 2 4 1500 40000 --order energy
CAPTURES
"$plat" --quiet bench chart --results "$results"
