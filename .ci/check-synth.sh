#!/usr/bin/env bash
# Whether others read what `plat synth` writes: a small capture of it, opened by pycolmap and by Khronos' glTF validator.
# Fetches both into a folder of its own. PLAT names the program; without it, it is built.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
synth=(synth --out "$scratch/city" --area-km2 0.05 --views 24 --size 96x54 --mesh --quiet)
if [[ -n "${PLAT:-}" ]]; then "$PLAT" "${synth[@]}"; else cargo run --release --locked -- "${synth[@]}"; fi

python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pycolmap==4.2.1
"$scratch/venv/bin/python" - "$scratch/city" <<'PYTHON'
import json, pathlib, sys
import pycolmap

city = pathlib.Path(sys.argv[1])
model = pycolmap.Reconstruction(str(city / "sparse/0"))
told = json.loads((city / "manifest.json").read_text())["summary"]
assert model.num_images() == told["views"], (model.num_images(), told)
assert model.num_points3D() == told["points"], (model.num_points3D(), told)
assert abs(model.compute_mean_track_length() - told["mean_track"]) < 1e-6, told
for image in model.images.values():
    assert (city / "images" / image.name).is_file(), image.name
for point in model.points3D.values():
    for element in point.track.elements:
        at = model.images[element.image_id].project_point(point.xyz)
        assert at is not None, "a point behind a camera that saw it"
print("pycolmap:", model.summary().replace("\n", " "))
PYTHON

npm install --silent --no-audit --no-fund --prefix "$scratch/npm" gltf-validator@2.0.0-dev.3.10
NODE_PATH="$scratch/npm/node_modules" node - "$scratch/city/city.glb" <<'NODE'
const validator = require('gltf-validator');
const bytes = new Uint8Array(require('fs').readFileSync(process.argv[2]));
validator.validateBytes(bytes, { maxIssues: 0 }).then(({ issues, info }) => {
  const { numErrors, numWarnings, numInfos, numHints, messages } = issues;
  for (const message of messages.filter(({ severity }) => severity < 2)) console.log(message);
  console.log(`glTF: ${numErrors} errors, ${numWarnings} warnings, ${numInfos} infos, ${numHints} hints;`,
    `${info.totalTriangleCount} triangles`);
  process.exitCode = numErrors > 0 ? 1 : 0;
});
NODE
