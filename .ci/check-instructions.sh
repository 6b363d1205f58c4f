#!/usr/bin/env bash
# Has a training step become dearer? Counts the instructions of a fixed training (train/examples/fixed_steps.rs) under valgrind and
# holds them to the recorded number, 3 % either way: seconds are noise on shared machines, instructions are not.
# `.ci/check-instructions.sh --record` records what is now; do that in the commit that means to change it, and say why.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
recorded=bench/instructions.json

command -v valgrind || { apt-get update -qq && apt-get install -qq --yes --no-install-recommends valgrind; }
# Without the GPU's code, which takes longest to build and is not counted.
cargo build --release --locked -p train --example fixed_steps --no-default-features
program="${CARGO_TARGET_DIR:-target}/release/examples/fixed_steps"

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
isa=$(valgrind --quiet --tool=callgrind --callgrind-out-file="$scratch/out" "$program")
count=$(awk '/^(summary|totals):/ { print $2; exit }' "$scratch/out")
[[ "$count" =~ ^[0-9]+$ ]] || { echo "valgrind counted nothing"; exit 1; }
compiler=$(rustc --version)

if [[ "${1:-}" == --record ]]; then
    printf '{"isa": "%s", "compiler": "%s", "instructions": %s}\n' "$isa" "$compiler" "$count" > "$recorded"
    cat "$recorded"
    exit
fi
field() { sed -n "s/.*\"$1\": \"\\{0,1\\}\\([^\",}]*\\).*/\\1/p" "$recorded"; }
if [[ "$(field isa)" != "$isa" ]]; then
    echo "skipped: instructions are recorded for $(field isa), kernels run on $isa here"
    exit
fi
[[ "$(field compiler)" == "$compiler" ]] || echo "note: recorded with $(field compiler), this is $compiler"
awk -v now="$count" -v then="$(field instructions)" 'BEGIN {
    change = 100 * (now / then - 1)
    printf "%.0f instructions, %.0f recorded: %+.2f %%\n", now, then, change
    if (change > 3 || change < -3) {
        print "more than 3 % off: if that is meant, .ci/check-instructions.sh --record and commit"
        exit 1
    }
}'
