#!/usr/bin/env bash
# Whether viewers draw what `plat export` writes as plat does: a small tree as 3D Tiles in CesiumJS in headless Chromium, from cameras of its
# capture, beside `plat render`. Prints the PSNR of each view, and keeps the pictures in OUT (out/viewers), Cesium's left. Not part of .ci/run.
# Half a minute. Needs Node, Debian's chromium, Python with NumPy and Pillow. PLAT names the program; without it, it is built.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
out=${OUT:-out/viewers}
mkdir -p "$out"
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
plat() { if [[ -n "${PLAT:-}" ]]; then "$PLAT" --quiet "$@"; else cargo run --release --locked --quiet -- --quiet "$@"; fi; }
plat synth --out "$scratch/city" --area-km2 0.05 --views 48 --size 320x180
plat train "$scratch/city" --out "$scratch/model" --levels 1 --residual 0 --steps 1200

web=$scratch/web
mkdir -p "$web"
npm install --silent --no-audit --no-fund --prefix "$web" cesium@1.145.0 playwright-core@1.64.1
plat export "$scratch/model" --to tiles --out "$web/tiles"
ln -s node_modules/cesium/Build/Cesium "$web/Cesium"
cp .ci/viewers/cesium.html "$web/"
python3 - "$scratch/city/transforms.json" "$web/cameras.json" <<'PYTHON'
import json, sys

capture = json.load(open(sys.argv[1]))
for kind in ("aerial", "street"):
    assert any(kind in frame["file_path"] for frame in capture["frames"]), kind
pick = lambda kind: [frame for frame in capture["frames"] if f"images/{kind}" in frame["file_path"]][3:12:4]
frames = pick("aerial") + pick("street")
for frame in frames:
    frame.pop("mask_path", None)
json.dump({"frames": frames}, open(sys.argv[2], "w"))
PYTHON
plat render "$scratch/model" --cameras "$web/cameras.json" --out "$scratch/ours"
count=$(python3 -c 'import json, sys; print(len(json.load(open(sys.argv[1]))["frames"]))' "$web/cameras.json")
mapfile -t indices < <(seq 0 $((count - 1)))
node .ci/viewers/cesium.mjs "$web" "$scratch" "${CHROMIUM:-/usr/bin/chromium}" 1 "${indices[@]}"
python3 - "$web/cameras.json" "$scratch" "$out" <<'PYTHON'
import json, math, sys
import numpy
from PIL import Image

cameras, scratch, out = sys.argv[1:]
worst = {}
for index, frame in enumerate(json.load(open(cameras))["frames"]):
    name = frame["file_path"].removeprefix("images/")
    pictures = [Image.open(f"{scratch}/{index}.png").convert("RGB"), Image.open(f"{scratch}/ours/images/{name}").convert("RGB")]
    theirs, ours = (numpy.asarray(picture, float) for picture in pictures)
    psnr = 10 * math.log10(255**2 / max(((theirs - ours) ** 2).mean(), 1e-9))
    both = Image.new("RGB", (2 * pictures[0].width, pictures[0].height))
    for side, picture in enumerate(pictures):
        both.paste(picture, (side * picture.width, 0))
    both.save(f"{out}/cesium-{name}")
    print(f"{name}: {psnr:.2f} dB between CesiumJS and plat")
    kind = name.split("-")[0]
    worst[kind] = min(worst.get(kind, math.inf), psnr)
# A black picture has 7 or 8 dB; right ones had 29 and more from the air, 25 and more on the street, one 23.
assert worst["aerial"] > 25 and worst["street"] > 18, worst
PYTHON
