#!/usr/bin/env bash
# Builds the base image from Debian's packages, for machines that cannot reach an image registry:
#     infra/docker/base.sh [SUITE]        debian:SUITE-slim; the default SUITE is bookworm
# With a registry this is not needed: `docker build` pulls the image of that name.
set -euo pipefail
suite=${1:-bookworm}
image="debian:$suite-slim"
docker image inspect "$image" >/dev/null 2>&1 && { echo "$image is there"; exit; }

# Files that the registry's slim image lacks as well. Copyright files are kept.
slim=()
for path in doc man info locale lintian groff; do slim+=("--dpkgopt=path-exclude=/usr/share/$path/*"); done
slim+=("--dpkgopt=path-include=/usr/share/doc/*/copyright")
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
mmdebstrap --quiet --variant=minbase --include=ca-certificates "${slim[@]}" "$suite" "$scratch/base.tar"
docker import --change 'CMD ["bash"]' "$scratch/base.tar" "$image"
