#!/usr/bin/env bash
# The lines of bench/results/gpu: training and stages on a card, and gsplat on the same card where Python has it (gsplat_card.py has its needs).
# Makes the dense street of bench/streets.sh in out/streets if it is not there. CAPTURES is the folder of fox.
# Its commands took the lines of e3d5608 one by one; about six minutes on an H100.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
plat=${PLAT:-target/release/plat}
fox=${CAPTURES:-../shared/data}/fox/pinhole_270
street=out/streets/dense_5m
results=${RESULTS:-bench/results/gpu}

if ! grep -qs '"complete": *true' "$street/manifest.json"; then
    "$plat" --quiet synth --area-km2 0.05 --views 600 --aerial 0.05 --traffic light --spacing 5 --size 480x270 --lidar --truth --out "$street"
fi
# train CAPTURE SCENE STEPS VIEWS SPLATS
train() {
    local label="plat whole, on a card"
    [[ $4 == 1 ]] || label+=", $4 views a step"
    "$plat" --quiet bench pareto "$1" --scene "$2" --label "$label" --blocks whole --backend gpu --steps "$3" --views-per-step "$4" \
        --budget "$5" --seed 0 --tolerance-db 0 --eval-every 0 --fresh --no-lidar --results "$results" --out "out/card/$2-$3-$4"
}
for steps in 400 1000 3000 10000; do
    train "$fox" fox "$steps" 1 36030
done
for steps in 1500 6000; do
    train "$street" dense_5m "$steps" 1 150000
    train "$street" dense_5m "$steps" 4 150000
done
train "$street" dense_5m 6000 8 150000
kernels() { "$plat" --quiet bench kernels --backend gpu --passes 100 --results "$results" "$@"; }
kernels --splats 12000
kernels --splats 150000
kernels --splats 150000 --views 8
kernels --splats 1000000 --size 1920x1080
model=out/card/dense_5m-6000-1
for size in 480x270 1920x1080; do
    kernels --model "$model" --cameras "$street" --size "$size"
    kernels --model "$model" --cameras "$street" --size "$size" --views 4
done

python3 -c 'import gsplat, fused_ssim' || { echo "bench/card.sh: Python lacks gsplat or fused_ssim: no line of gsplat" >&2; exit 0; }
gsplat() { python3 bench/gsplat_card.py "$@" >>"$results/gsplat.jsonl"; }
gsplat train "$fox" --scene fox --steps 3000 --cap 36030
for steps in 1500 6000; do
    gsplat train "$street" --steps "$steps" --cap 150000
done
gsplat train "$street" --steps 6000 --strategy default
for size in 480x270 1920x1080; do
    gsplat render "$street" --ply "$model/merged.ply" --size "$size"
done
