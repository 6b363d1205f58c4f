#!/usr/bin/env bash
# The dashboard: whether the committed dist/ is what its sources give; its tests against a simulated server; and a real job in a cluster, watched
# through the pages while workers and the coordinator are killed. Prints a line for each thing shown, and leaves screenshots of every page, light
# and dark, in OUT (out/dashboard). PLAT names the program, whose pages are tested; without it, it is built. CHROMIUM names the browser.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export OUT=${OUT:-out/dashboard} CHROMIUM=${CHROMIUM:-/usr/bin/chromium}
mkdir -p "$OUT"
OUT=$(realpath "$OUT")

missing=()
command -v npm >/dev/null || missing+=(nodejs npm)
[[ -x $CHROMIUM ]] || missing+=(chromium)
((${#missing[@]} == 0)) || { apt-get update -qq && apt-get install -qq --yes --no-install-recommends "${missing[@]}"; }
[[ -n "${PLAT:-}" ]] || { cargo build --release --locked -p cli; PLAT="${CARGO_TARGET_DIR:-target}/release/plat"; }
PLAT=$(realpath "$PLAT")
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
began=$SECONDS
step() { printf -- '-- %s (after %d s)\n' "$1" "$((SECONDS - began))"; }

step "dist is what the sources give"
copy=$scratch/dashboard
git ls-files -z dashboard ':!dashboard/dist' | xargs -0 cp --parents --target-directory "$scratch"
(cd "$copy" && npm ci --silent --no-audit --no-fund && npm run --silent build -- --logLevel warn)
# Against what is committed, or is about to be: the files that git knows.
mkdir "$scratch/committed"
git ls-files -z dashboard/dist | xargs -0 cp --parents --target-directory "$scratch/committed"
diff --brief --recursive "$copy/dist" "$scratch/committed/dashboard/dist" || {
    echo "dashboard/dist is not what its sources give: (cd dashboard && npm ci && npm run build), and commit dist"
    exit 1
}
echo "ok $(find "$copy/dist" -type f | wc -l) files, byte for byte"

step "tests against the simulated server"
(cd "$copy" && PLAT_SHOTS="$OUT" npm run --silent pages) >"$scratch/tests.log" 2>&1 || { cat "$scratch/tests.log"; exit 1; }
grep -E '^ok|^# (pass|fail)' "$scratch/tests.log"

step "a real job"
"$PLAT" synth --out "$scratch/city" --area-km2 0.05 --views 48 --size 240x160 --quiet >/dev/null
(cd "$copy" && PLAT="$PLAT" CAPTURE="$scratch/city" PLAT_SHOTS="$OUT" node tests/real.mjs)
step "done: $(find "$OUT" -name '*.png' | wc -l) screenshots in $OUT"
