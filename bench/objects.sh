#!/usr/bin/env bash
# Lines of bench/results/prune.jsonl with what detectors find, and bench/results/prune.svg: a generated street with traffic, pruned to a half, a
# quarter and a tenth of its splats by every order. Zones are those of YOLOX-nano; FastestDet only judges. Makes the street in out/objects if it
# is not there. Takes the folder with the detectors. RESULTS is the folder of the lines. Half an hour.
set -euo pipefail
repository=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
# Lines of results name the command, so that its paths must not be those of one machine.
detectors=$(realpath --relative-to="$repository" "${1:?the folder of the detectors}")
cd "$repository"
plat=${PLAT:-target/release/plat}
results=${RESULTS:-bench/results}
street=out/objects/street
model=out/objects/model

if ! grep -qs '"complete": *true' "$street/manifest.json"; then
    "$plat" --quiet synth --area-km2 0.02 --views 640 --spacing 2 --aerial 0.1 --traffic medium --size 640x360 --out "$street"
fi
"$plat" --quiet train "$street" --out "$model" --fresh --blocks whole --steps 6000 --budget 40000 --threads 1 --backend cpu --tolerance-db 0
"$plat" --quiet bench prune "$model" "$street" --scene objects --tolerance-db 0 --keep 0.5,0.25,0.1 --results "$results" \
    --detector "$detectors/yolox_nano_416.onnx" --judge "$detectors/yolox_nano_416.onnx" --judge "$detectors/fastestdet_352.onnx"
"$plat" --quiet bench chart --results "$results"
