#!/usr/bin/env bash
# The lines of bench/results/levels: a small capture as one block and as trees of one to three levels, equal steps, three seeds, nothing pruned.
# Takes the folder of the captures. RESULTS is the folder of the lines. Ten minutes on one core.
set -euo pipefail
repository=$(realpath "$(dirname "${BASH_SOURCE[0]}")/..")
# Lines of results name the command, so that its paths must not be those of one machine.
data=$(realpath --relative-to="$repository" "${1:?the folder of the captures}")
cd "$repository"
plat=${PLAT:-target/release/plat}

run() {
    "$plat" --quiet bench pareto "$data/aerial_caliterra" --steps 2400 --budget 16000 --downscale 4 --seed 0,1,2 --threads 1 --backend cpu --tolerance-db 0 \
        --residual 0 --eval-every 0 --fresh --results "${RESULTS:-bench/results/levels}" "$@"
}
for levels in 0 1 2; do
    run --label "plat, $((levels + 1)) levels" --levels "$levels" --out "out/levels/$levels"
done
run --label "plat, one block" --blocks whole --out out/levels/whole
