#!/usr/bin/env bash
# Checks README, ARCHITECTURE and the book in docs/: their length, links and anchors, and that the book builds with every chapter in it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export PATH="${CARGO_HOME:-$HOME/.cargo}/bin:$PATH" LC_ALL=C.UTF-8
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
failed=0
fail() { echo "$1" >&2; failed=1; }

# At most so many lines of at most 120 characters.
while read -r file lines; do
    count=$(wc -l < "$file")
    ((count <= lines)) || fail "$file: has $count lines; at most $lines"
    long=$(grep -nE '^.{121,}' "$file" | cut -d: -f1 | paste -sd' ' || true)
    [[ -z $long ]] || fail "$file: lines of over 120 characters: $long"
done <<'LIMITS'
README.md 120
ARCHITECTURE.md 150
LIMITS

# Links and images to files and headings; addresses on the web are not followed. The book keeps the folders of docs/, so a link that holds here
# holds there, unless it leads out of docs/.
command -v npm >/dev/null || { apt-get update -qq && apt-get install -qq --yes --no-install-recommends nodejs npm; }
npm install --silent --no-fund --no-audit --no-save --prefix "$scratch" remark-cli@12.0.1 remark-validate-links@13.1.0
"$scratch/node_modules/.bin/remark" --no-config --frail --quiet --no-stdout --no-color \
    --use "$scratch/node_modules/remark-validate-links/index.js=repository:false" README.md ARCHITECTURE.md docs || failed=1
if outside=$(grep -nE '\]\((\.\./\.\./|/)' docs/src/*.md docs/decisions/*.md); then fail "these links lead out of the book: $outside"; fi

mdbook --version 2>/dev/null | grep -q ' v0\.5\.' || cargo install mdbook --version 0.5.4 --locked --debug --no-default-features
mdbook build --dest-dir "$scratch/book" docs 2>&1 | tee "$scratch/log"
! grep -q 'WARN\|ERROR' "$scratch/log" || fail "mdbook warns"
for chapter in docs/src/*.md docs/decisions/*.md; do
    page=${chapter#docs/}
    [[ -s "$scratch/book/${page%.md}.html" ]] || fail "$chapter: is not in docs/SUMMARY.md"
done
for decision in docs/decisions/*.md; do
    name=$(basename "$decision")
    [[ $name =~ ^[0-9]{4}-[a-z0-9-]+\.md$ ]] || fail "$decision: give it a name like 0001-short-title.md"
    grep -q "(../decisions/$name)" docs/src/decisions.md || fail "$decision: is not listed in docs/src/decisions.md"
done
exit "$failed"
