#!/usr/bin/env bash
# Lines of bench/results/tracks: the paths of traffic that plat objects track finds in generated streets, against the true ones: from a lidar,
# a radar, YOLOX-nano on the photos, and two and three of them. Rules and constants were chosen by the streets medium, fog and heavy; by other
# only how near boxes lie to a path (1.0 instead of 0.9 standard deviations). Takes the folder of the captures and detectors. RESULTS is the
# folder of the lines. Makes the streets in out/tracks if they are not there, which is most of half an hour; with streets and detections there
# it takes two minutes.
set -euo pipefail
repository=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
data=$(realpath --relative-to="$repository" "${1:?the folder of the detectors}")
cd "$repository"
plat=${PLAT:-target/release/plat}
results=${RESULTS:-bench/results/tracks}
mkdir -p "$results"
while read -r street options; do
    at=out/tracks/$street
    # shellcheck disable=SC2086 # several options
    grep -qs '"complete": *true' "$at/manifest.json" || "$plat" --quiet synth $options --aerial 0 --spacing 2 --lidar --radar --out "$at" </dev/null
    photos="--detector $data/detectors/yolox_nano_416.onnx --store out/tracks/store-$street"
    for from in "--no-radar" "" "$photos --no-radar" "$photos" "--no-lidar" "$photos --no-lidar --no-radar" "$photos --no-lidar"; do
        # shellcheck disable=SC2086 # several options
        said=$("$plat" --quiet objects track "$at" --out "out/tracks/$street.json" --svg "out/tracks/$street.svg" \
            --against "$at/tracks.json" $from --json </dev/null)
        python3 - "$street" "$(git rev-parse --short=12 HEAD)" "$from" "$said" <<'PYTHON' | tee -a "$results/plat.jsonl"
import json, sys
street, commit, options, said = sys.argv[1:]
line = json.loads(said)
line.pop("out")
print(json.dumps({"kind": "object tracks", "commit": commit, "street": street, "options": options} | line))
PYTHON
    done
done <<'STREETS'
medium --area-km2 0.02 --views 480 --traffic medium --size 640x360
fog --area-km2 0.02 --views 480 --traffic medium --size 640x360 --fault fog
heavy --area-km2 0.05 --seed 3 --layout grid --views 720 --traffic heavy --size 960x540
other --area-km2 0.03 --seed 11 --views 480 --traffic heavy --size 640x360
STREETS
