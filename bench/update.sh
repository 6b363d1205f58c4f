#!/usr/bin/env bash
# Lines of bench/results/update: a car is parked in a generated street whose model is finished, sixteen fixed cameras see it, and eight
# of them are trained on; then it has left again. RESULTS is the folder of the lines. Fifteen minutes of two cores, of which the city's
# model takes most.
set -euo pipefail
repository=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
cd "$repository"
plat=${PLAT:-target/release/plat}
results=${RESULTS:-bench/results/update}
at=${OUT:-out/update}
mkdir -p "$results" "$at"
city=(--area-km2 0.02 --layout grid --traffic none --seed 5 --size 640x400)
capture() {
    local name=$1
    shift
    grep -qs '"complete": *true' "$at/$name/manifest.json" || "$plat" --quiet synth "${city[@]}" "$@" --out "$at/$name" >/dev/null
}
capture city --views 300 --aerial 0.3
capture new_photos --watch 10,10,8 --views 16 --parked
capture old_photos --watch 10,10,8 --views 16
[[ -f $at/model/model/model.json ]] ||
    "$plat" --quiet train "$at/city" --steps 4000 --budget 60000 --levels 1 --out "$at/model" >/dev/null
read -r area box < <(python3 - "$at/new_photos/manifest.json" <<'PYTHON'
import json, sys
watched = json.load(open(sys.argv[1]))["summary"]["watched"]
print(",".join(map(str, watched["place"] + [5])), ",".join(map(str, watched["parked"])))
PYTHON
)
update() {
    local case=$1 model=$2 photos=$3 steps=$4
    rm -rf "${at:?}/$case"
    "$plat" --quiet update "$at/$model" --area "$area" --box "$box" --photos "$at/$photos" --test-every 2 --steps "$steps" \
        --backend cpu --out "$at/$case" --json | python3 -c '
import json, sys
case, commit = sys.argv[1:]
said = json.loads(sys.stdin.read().splitlines()[-1])
keys = ("machine", "backend", "threads", "steps", "photos", "area_splats", "blocks", "training_seconds", "training_cpu_seconds",
        "finest_training_seconds", "finest_training_cpu_seconds", "trained_on", "held_out", "trained_on_box", "held_out_box")
print(json.dumps({"kind": "update", "case": case, "commit": commit} | {key: said[key] for key in keys}))
' "$case" "$(git rev-parse --short=12 HEAD)" | tee -a "$results/plat.jsonl"
}
update parked model new_photos 200
update parked model new_photos 300
update left parked old_photos 300
