#!/usr/bin/env bash
# Makes the base image of all our images from Debian's packages, where no registry of images can be reached:
#     infra/docker/base.sh [SUITE]        debian:SUITE-slim; SUITE is bookworm unless given
# Where one can, `docker build` fetches the image of that name and this is not needed.
set -euo pipefail
suite=${1:-bookworm}
image="debian:$suite-slim"
docker image inspect "$image" >/dev/null 2>&1 && { echo "$image is there"; exit; }

# What the slim image of a registry leaves out, too. Copyright files stay.
slim=()
for path in doc man info locale lintian groff; do slim+=("--dpkgopt=path-exclude=/usr/share/$path/*"); done
slim+=("--dpkgopt=path-include=/usr/share/doc/*/copyright")
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
mmdebstrap --quiet --variant=minbase --include=ca-certificates "${slim[@]}" "$suite" "$scratch/base.tar"
docker import --change 'CMD ["bash"]' "$scratch/base.tar" "$image"
