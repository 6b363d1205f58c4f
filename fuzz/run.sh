#!/usr/bin/env bash
# Runs every fuzz target for so many seconds (60) and fails at the first crash. Needs a C++ compiler, and cargo-fuzz
# (cargo install cargo-fuzz --version 0.13.2 --locked). The toolchain may be stable: the one thing that libFuzzer's
# instrumentation needs of nightly is the permission, RUSTC_BOOTSTRAP.
#
#     fuzz/run.sh [SECONDS [TARGET...]]
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
PLAT_FUZZ_CASES=0 PLAT_FUZZ_SEEDS="$PWD/fuzz/seeds" cargo test --locked -q -p dataset --test mutated

export RUSTC_BOOTSTRAP=1
for target in "${targets[@]}"; do
    echo "== fuzz $target, $seconds s"
    mkdir -p "fuzz/corpus/$target" "fuzz/seeds/$target"
    # A gigabyte is four times what a file of 10 MB may take. 10 s for one input is a hang.
    cargo fuzz run "$target" "fuzz/corpus/$target" "fuzz/seeds/$target" -- \
        -max_total_time="$seconds" -rss_limit_mb=1024 -malloc_limit_mb=256 -timeout=10 -max_len=65536 -print_final_stats=1
done
echo "all of ${#targets[@]} targets ran for $seconds s without a crash"
