#!/usr/bin/env bash
# Lines of bench/results/stability.jsonl, the table of docs/src/stability.md, and a picture of each case in out/stability/pictures.
# Takes the folder of the captures and detectors, and further options of plat bench stability. An hour of one core.
set -euo pipefail
repository=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
# Lines of results name the command, so that its paths must not be those of one machine.
data=$(realpath --relative-to="$repository" "${1:?the folder of the captures}")
shift
cd "$repository"
given=()
# Captures of others that show a failure; with --case, those of its cases.
for capture in moving-unmasked=drive_dgp_scene_01 sparse-views=drive_dgp_scene_01 exposure-drift=street_lund; do
    case=${capture%%=*} folder=$data/${capture#*=}
    [[ -d $folder && ( " $* " != *" --case "* || " $* " =~ [\ ,]"$case"[\ ,] ) ]] && given+=("$case=$folder")
done
RAYON_NUM_THREADS=1 "${PLAT:-target/release/plat}" --quiet bench stability --out out/stability --pictures out/stability/pictures \
    --document "${DOCUMENT:-docs/src/stability.md}" --results "${RESULTS:-bench/results}" \
    --detector "$data/detectors/yolox_nano_416.onnx" --detector "$data/detectors/fastestdet_352.onnx" "$@" "${given[@]}" </dev/null
