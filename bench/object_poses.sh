#!/usr/bin/env bash
# Lines of bench/results/poses: rotations and heights of traffic from positions alone, on the road of a model, for five layouts of streets.
# Positions are the true ones, a tenth of a metre off along the ground and half a metre in height, one in seven missing; what plat objects
# pose makes of them is measured against the truth. RESULTS is the folder of the lines. Ten minutes of two cores.
set -euo pipefail
repository=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
cd "$repository"
plat=${PLAT:-target/release/plat}
results=${RESULTS:-bench/results/poses}
mkdir -p "$results"
for layout in grid curved-corridor alley winding deck; do
    at=out/poses/$layout
    grep -qs '"complete": *true' "$at/city/manifest.json" ||
        "$plat" --quiet synth --area-km2 0.03 --views 112 --size 320x180 --aerial 0.2 --spacing 4 --traffic medium --layout "$layout" --out "$at/city"
    [[ -f $at/model/model/model.json ]] ||
        "$plat" --quiet train "$at/city" --steps 2000 --budget 20000 --levels 0 --tolerance-db 0 --out "$at/model" >/dev/null
    python3 - "$at" <<'PYTHON'
import json, random, sys
at = sys.argv[1]
chance = random.Random(0)
tracks = []
for track in json.load(open(f"{at}/city/tracks.json"))["tracks"]:
    if track["class"] not in ("car", "truck", "bus", "motorcycle", "bicycle"):
        continue
    near = lambda by: by * (2 * chance.random() - 1)
    kept = [pose for i, pose in enumerate(track["poses"]) if i % 7 != 3]
    positions = [[t, [x + near(0.1), y + near(0.1), z + near(0.5)]] for t, (x, y, z), _ in kept]
    tracks.append({key: track[key] for key in ("instance", "class", "low", "high")} | {"positions": positions})
json.dump({"tracks": tracks}, open(f"{at}/positions.json", "w"))
PYTHON
    said=$("$plat" --quiet objects pose "$at/model" --positions "$at/positions.json" --against "$at/city/tracks.json" --out "$at/tracks.json" --json)
    python3 - "$layout" "$(git rev-parse --short=12 HEAD)" "$said" <<'PYTHON' | tee -a "$results/plat.jsonl"
import json, sys
layout, commit, said = sys.argv[1:]
line = json.loads(said)
line.pop("out")
print(json.dumps({"kind": "object poses", "commit": commit, "layout": layout} | line))
PYTHON
done
