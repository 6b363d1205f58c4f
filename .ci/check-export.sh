#!/usr/bin/env bash
# Whether others read what `plat export` writes: a small tree as streamed SOG, opened by PlayCanvas' splat-transform, which counts its levels
# and writes each back as PLY; the finest must look as the model does; and as 3D Tiles, whose glTF Khronos' validator reads (.ci/check-viewers.sh
# draws them). Fetches both, and the Node that the first wants, into a folder of its own. PLAT names the program; without it, it is built.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
plat() { if [[ -n "${PLAT:-}" ]]; then "$PLAT" --quiet "$@"; else cargo run --release --locked --quiet -- --quiet "$@"; fi; }
plat synth --out "$scratch/city" --area-km2 0.05 --views 48 --size 160x90
plat train "$scratch/city" --out "$scratch/model" --levels 1 --residual 0 --steps 600
plat export "$scratch/model" --to sog --out "$scratch/sog"

npm install --silent --no-audit --no-fund --prefix "$scratch/npm" node@22 @playcanvas/splat-transform@3.7.0 gltf-validator@2.0.0-dev.3.10 \
    3d-tiles-tools@0.5.4
transform() { "$scratch/npm/node_modules/node/bin/node" "$scratch/npm/node_modules/@playcanvas/splat-transform/bin/cli.mjs" --gpu cpu "$@" 2>"$scratch/log" || { cat "$scratch/log" >&2; return 1; }; }
transform "$scratch/sog/lod-meta.json" --info json null >"$scratch/info"
python3 - "$scratch/sog/lod-meta.json" "$scratch/info" <<'PYTHON'
import json, sys

ours, text = json.load(open(sys.argv[1])), open(sys.argv[2]).read()
theirs = json.loads(text[text.index("{") : text.rindex("}") + 1])
print("splat-transform:", theirs)
assert theirs["lodCounts"] == ours["counts"] and theirs["numLods"] == ours["lodLevels"] == 2, ours["counts"]
assert theirs["shBands"] == 3 and ours["counts"][0] > ours["counts"][1] > 0, ours["counts"]
PYTHON
# The environment is not part of a level: the model is compared with all of both.
for level in 0 1; do
    transform "$scratch/sog/lod-meta.json" --select-lod "$level" "$scratch/$level.ply"
    transform "$scratch/$level.ply" "$scratch/sog/env.sog" "$scratch/whole-$level.ply"
done
psnr() { plat eval "$1" "$scratch/city" --json | tail -1 | python3 -c 'import json, sys; print(json.load(sys.stdin)["psnr"])'; }
python3 - "$(psnr "$scratch/model")" "$(psnr "$scratch/whole-0.ply")" "$(psnr "$scratch/whole-1.ply")" <<'PYTHON'
import sys

model, finest, coarsest = map(float, sys.argv[1:])
print(f"PSNR of the model {model:.2f} dB, of the finest level {finest:.2f} dB, of the coarsest {coarsest:.2f} dB")
assert model - 0.3 < finest < model + 0.3 and coarsest < finest
PYTHON

# The validator does not know the extensions, so it objects to their attributes' names; to nothing else may it object.
plat export "$scratch/model" --to tiles --out "$scratch/tiles"
cat >"$scratch/npm/validate.cjs" <<'NODE'
const { validateBytes } = require("gltf-validator");
const { readFileSync } = require("node:fs");
Promise.all(process.argv.slice(2).map(async (path) => {
    const { messages } = (await validateBytes(new Uint8Array(readFileSync(path)), { maxIssues: 0 })).issues;
    const errors = messages.filter(({ severity, pointer }) => severity < 2 && !/attributes\/KHR_gaussian_splatting:/.test(pointer));
    if (errors.length) throw new Error(`${path}: ${JSON.stringify(errors)}`);
    console.log(`gltf-validator: ${path.split("/").pop()} is glTF`);
})).catch((error) => { console.error(error.message); process.exit(1); });
NODE
"$scratch/npm/node_modules/node/bin/node" "$scratch/npm/validate.cjs" "$scratch"/tiles/*.glb

# Tools that follow the tileset's links find every tile; the leaves and the backdrop have all splats of the model.
tiles() { "$scratch/npm/node_modules/node/bin/node" "$scratch/npm/node_modules/3d-tiles-tools/build/src/cli.mjs" "$@" >"$scratch/log" 2>&1 || { cat "$scratch/log" >&2; return 1; }; }
tiles convert -i "$scratch/tiles/tileset.json" -o "$scratch/tiles.3tz"
for tile in "$scratch"/tiles/*.glb; do tiles analyze -i "$tile" -o "$scratch/analysed"; done
plat export "$scratch/model" --to ply --out "$scratch/model.ply"
plat export "$scratch/model" --to spz --out "$scratch/model.spz"
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check gsply==0.4.6
"$scratch/venv/bin/python" - "$scratch" <<'PYTHON'
import json, pathlib, re, sys, zipfile
import gsply, numpy

scratch = pathlib.Path(sys.argv[1])
model, packed = gsply.plyread(scratch / "model.ply"), gsply.read_spz(scratch / "model.spz")
raw = (scratch / "model.ply").read_bytes()
header, body = raw[: raw.index(b"end_header\n") + 11], raw[raw.index(b"end_header\n") + 11 :]
names = re.findall(rb"property float (\w+)", header)
own = dict(zip(names, numpy.frombuffer(body, "<f4").reshape(-1, len(names)).T))
for name, column in ((b"x", model.means[:, 0]), (b"f_dc_2", model.sh0[:, 2]), (b"rot_3", model.quats[:, 3]), (b"opacity", model.opacities.ravel())):
    assert numpy.array_equal(own[name], column), name
# gsply takes SPZ's axes as stored: y and z about.
assert packed.means.shape == model.means.shape and numpy.abs(packed.means * [1, -1, -1] - model.means).max() < 1e-3
print(f"gsply: {len(model.means)} splats in PLY and SPZ, SH degree {model.get_sh_degree()}")

def finest(tile):
    children = tile.get("children", [])
    own = [tile["content"]["uri"]] if "content" in tile and (not children or tile.get("refine") == "ADD") else []
    return own + [uri for child in children for uri in finest(child)]

with zipfile.ZipFile(scratch / "tiles.3tz") as pack:
    tileset = json.loads(pack.read("tileset.json"))
    assert set(finest(tileset["root"])) <= set(pack.namelist())
count = lambda uri: json.loads((scratch / "analysed" / f"{uri}.glb.json").read_text())["accessors"][0]["count"]
assert sum(map(count, finest(tileset["root"]))) == len(model.means)
print(f"3d-tiles-tools: {len(finest(tileset['root']))} finest tiles with all splats")
PYTHON
