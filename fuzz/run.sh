#!/usr/bin/env bash
# Runs every fuzz target for so many seconds (60) and fails at the first crash. Needs a C++ compiler, and cargo-fuzz
# (cargo install cargo-fuzz --version 0.13.2 --locked). The toolchain may be stable: the one thing that libFuzzer's
# instrumentation needs of nightly is the permission, RUSTC_BOOTSTRAP.
#
#     fuzz/run.sh [SECONDS [TARGET...]]      0 seconds: only builds
#
# Seeds come from plat's own writers and, where it is there, from ../shared/data; they are made anew each time and never
# committed. What a crash leaves is in fuzz/artifacts; `cargo fuzz run TARGET FILE` (with RUSTC_BOOTSTRAP=1) repeats it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
seconds=${1:-60}
shift || true
targets=("$@")
if [ ${#targets[@]} -eq 0 ]; then
    for file in fuzz/fuzz_targets/*.rs; do targets+=("$(basename "$file" .rs)"); done
fi

rm -rf fuzz/seeds
# All packages of the workspace, so that dependencies have the features that `cargo test` built them with.
PLAT_FUZZ_CASES=0 PLAT_FUZZ_SEEDS="$PWD/fuzz/seeds" cargo test --locked -q --test mutated

export RUSTC_BOOTSTRAP=1
for target in "${targets[@]}"; do
    mkdir -p "fuzz/corpus/$target" "fuzz/seeds/$target" fuzz/artifacts/"$target"
    cargo fuzz build "$target"
done

((seconds > 0)) || exit 0

logs=$(mktemp -d)
trap 'rm -rf "$logs"' EXIT
host=$(rustc -vV | sed -n 's/^host: //p')
fuzz_one() {
    # A gigabyte is four times what a file of 10 MB may take. 10 s for one input is a hang.
    "${CARGO_TARGET_DIR:-fuzz/target}/$host/release/$1" "fuzz/corpus/$1" "fuzz/seeds/$1" "-artifact_prefix=fuzz/artifacts/$1/" \
        -max_total_time="$seconds" -rss_limit_mb=1024 -malloc_limit_mb=256 -timeout=10 -max_len=65536 -print_final_stats=1 \
        > "$logs/$1" 2>&1 || { echo "== fuzz $1 failed"; tail -40 "$logs/$1"; return 1; }
    echo "== fuzz $1, $seconds s: $(sed -n 's/^stat::number_of_executed_units: *//p' "$logs/$1") inputs"
}
export -f fuzz_one
export seconds logs host
# libFuzzer takes one core; targets run side by side.
# The inner bash expands $0, so the quotes are single.
# shellcheck disable=SC2016
printf '%s\0' "${targets[@]}" | xargs -0 -n 1 -P "$(nproc)" bash -c 'fuzz_one "$0"'
echo "${#targets[@]} targets ran for $seconds s each without a crash"
