#!/usr/bin/env bash
# Lines of bench/results/stability.jsonl, the table of docs/src/stability.md, and a picture of each case in out/stability/pictures.
# Takes the folder of the captures and detectors, and further options of plat bench stability. An hour of one core.
set -euo pipefail
repository=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
# Lines of results name the command, so that its paths must not be those of one machine.
data=$(realpath --relative-to="$repository" "${1:?the folder of the captures}")
shift
cd "$repository"
RAYON_NUM_THREADS=1 "${PLAT:-target/release/plat}" --quiet bench stability --out out/stability --pictures out/stability/pictures \
    --document docs/src/stability.md --results "${RESULTS:-bench/results}" \
    --detector "$data/detectors/yolox_nano_416.onnx" --detector "$data/detectors/fastestdet_352.onnx" "$@" </dev/null
