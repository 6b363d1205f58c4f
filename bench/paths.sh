#!/usr/bin/env bash
# Lines of bench/results/paths: a generated street with traffic whose objects are trained with true paths, with paths that are wrong (by
# 0.15 m and 2°, alike within a second), and with those that plat objects track finds. `moving_psnr` is of the pixels within the true boxes
# on held-out photos, `psnr` of all others. Makes the street in out/paths if it is not there. SEED has the seeds (0,1). RESULTS is the folder of
# the lines. Ten minutes of one core.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
plat=${PLAT:-target/release/plat}
results=${RESULTS:-bench/results/paths}
out=out/paths
mkdir -p "$results"
if ! grep -qs '"complete": *true' "$out/true/manifest.json"; then
    "$plat" --quiet synth --area-km2 0.02 --views 480 --spacing 2 --aerial 0 --lidar --traffic medium --size 640x360 --out "$out/true"
fi
for capture in wrong own; do
    [[ -d $out/$capture ]] || cp -al "$out/true" "$out/$capture"
    rm -f "$out/$capture/tracks.json"
done
"$plat" --quiet objects track "$out/true" --out "$out/own/tracks.json" >/dev/null
python3 - "$out" <<'PYTHON'
import json, math, random, sys
out = sys.argv[1]
true = json.load(open(f"{out}/true/tracks.json"))
own = json.load(open(f"{out}/own/tracks.json"))
json.dump(own | {"seconds": true["seconds"]}, open(f"{out}/own/tracks.json", "w"))
draw = random.Random(1)
for track in true["tracks"]:
    knots = [[draw.gauss(0, sigma) for sigma in (0.2, 0.2, 0.05, math.radians(3))] for _ in range(200)]
    first = track["poses"][0][0]
    for seconds, place, turn in track["poses"]:
        at, share = divmod(seconds - first, 1.0)
        x, y, z, yaw = (a + share * (b - a) for a, b in zip(knots[int(at) % 199], knots[int(at) % 199 + 1]))
        place[:] = [place[0] + x, place[1] + y, place[2] + z]
        s, c = math.sin(yaw / 2), math.cos(yaw / 2)
        a, b, d, e = turn
        turn[:] = [c * a - s * b, c * b + s * a, c * d + s * e, c * e - s * d]
json.dump(true, open(f"{out}/wrong/tracks.json", "w"))
PYTHON
for seed in $(tr , ' ' <<<"${SEED:-0,1}"); do
    for capture in true wrong own; do
        "$plat" --quiet train "$out/$capture" --out "$out/model" --steps 2500 --budget 20000 --levels 1 --threads 1 --backend cpu --objects \
            --fresh --eval-every 0 --seed "$seed" >/dev/null
        said=$("$plat" --quiet eval "$out/model" "$out/true" --json)
        python3 - "$capture" "$seed" "$out/model/report.json" "$said" <<'PYTHON' | tee -a "$results/plat.jsonl"
import json, sys
capture, seed, report, said = sys.argv[1:]
said, report = json.loads(said), json.load(open(report))
print(json.dumps({"kind": "object paths", "commit": said["commit"], "machine": said["machine"], "paths": capture, "seed": int(seed),
                  "moving_psnr": said["moving"]["psnr"], "psnr": said["psnr"], "cpu_seconds": report["cpu_seconds"]}))
PYTHON
    done
done
