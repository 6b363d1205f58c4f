#!/usr/bin/env bash
# The lines of bench/results/ladder: what each cause is worth on street photos. The beds of bench/streets.sh are trained with one thing changed
# at a time, equal steps, one seed (SEED), one thread, nothing pruned. Run bench/streets.sh first: it makes the beds.
# Takes the beds (dense_5m city_0.3). DETECTOR is the ONNX file of a detector. Needs Python with NumPy and Pillow. An hour or two on one core.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
plat=${PLAT:-target/release/plat}
detector=(${DETECTOR:+--detector "$(realpath --relative-to=. "$DETECTOR")"})

# A copy of a capture (hard links) whose masks hide something from training; the held-out views keep theirs.
# masked BED COPY WHAT: WHAT is "sky" (class 10) or "aerial" (all pixels of aerial photos).
masked() {
    [[ ! -e $2/complete ]] || return 0
    rm -rf "$2" && mkdir -p "$(dirname "$2")" && cp -al "$1" "$2"
    python3 - "$@" <<'PYTHON'
import os, sys
import numpy
from PIL import Image

bed, copy, what = sys.argv[1:]
for index, name in enumerate(sorted(os.listdir(f"{bed}/images"))):
    if index % 8 == 0 or (what == "aerial" and not name.startswith("aerial")):
        continue
    path = f"{copy}/masks/{name}"
    mask = numpy.array(Image.open(path))
    mask[numpy.array(Image.open(f"{bed}/semantic/{name}")) == 10 if what == "sky" else slice(None)] = 0
    # The file has hard links: a new one takes its place.
    os.remove(path)
    Image.fromarray(mask).save(path)
PYTHON
    touch "$2/complete"
}

run() {
    local label=$1 capture=$2
    shift 2
    "$plat" --quiet bench pareto "$bed=$capture" --label "$label" --steps "$steps" --seed "${SEED:-0}" --threads 1 --backend cpu --tolerance-db 0 \
        --eval-every 0 --depth "${detector[@]}" --fresh --results "${RESULTS:-bench/results/ladder}" --out "out/ladder/$bed-run" "$@"
}

for bed in "${@:-dense_5m}"; do
    case $bed in
        dense_5m) steps=1500 splats=150000 ;;
        city_0.3) steps=3400 splats=340000 ;;
        *) echo "bench/ladder.sh: no bed has the name $bed: dense_5m and city_0.3 do" >&2; exit 2 ;;
    esac
    photos=out/streets/$bed
    [[ -d $photos ]] || { echo "bench/ladder.sh: $photos does not exist: run bench/streets.sh $bed first, which makes it" >&2; exit 2; }
    masked "$photos" "out/ladder/$bed-sky" sky
    masked "$photos" "out/ladder/$bed-aerial" aerial
    for rung in ${RUNGS:-usual splats2 splats4 sky aerial points points4 depth both sparse lidar levels2 levels3 whole}; do
        case $rung in
            usual) run "as usual" "$photos" --budget "$splats" --no-lidar ;;
            splats2) run "2 times the splats" "$photos" --budget $((2 * splats)) --no-lidar --levels 0 ;;
            splats4) run "4 times the splats" "$photos" --budget $((4 * splats)) --no-lidar --levels 0 ;;
            sky) run "sky masked" "out/ladder/$bed-sky" --budget "$splats" --no-lidar ;;
            aerial) run "no aerial photos" "out/ladder/$bed-aerial" --budget "$splats" --no-lidar ;;
            points) run "lidar starts splats" "$photos" --budget "$splats" ;;
            points4) run "lidar starts splats, 4 times the splats" "$photos" --budget $((4 * splats)) --levels 0 ;;
            depth) run "true depth as a loss" "$photos" --budget "$splats" --no-lidar --depths "$photos/depth" --depth-weight 0.8 ;;
            both) run "lidar starts splats, true depth as a loss" "$photos" --budget "$splats" --depths "$photos/depth" --depth-weight 0.8 ;;
            sparse) run "depths of sparse points as a loss" "$photos" --budget "$splats" --no-lidar --depth-weight 0.8 ;;
            lidar) run "lidar starts splats, its depths as a loss" "$photos" --budget "$splats" --depth-weight 0.8 ;;
            levels2) run "two levels" "$photos" --budget "$splats" --no-lidar --levels 1 --residual 0 ;;
            levels3) run "three levels" "$photos" --budget "$splats" --no-lidar --levels 2 --residual 0 ;;
            whole) run "one block without a tree" "$photos" --budget "$splats" --no-lidar --blocks whole ;;
            *) echo "bench/ladder.sh: no rung has the name $rung: see the list in this file" >&2; exit 2 ;;
        esac
    done
done
