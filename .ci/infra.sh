#!/usr/bin/env bash
# What of infra/ can be held to something without a cloud: Kubernetes' manifests against its schemas and against the program they start,
# dashboards and Compose against what they refer to, Terraform's policies by their tests, Slurm's launcher on a real Slurm of one node.
# PLAT names the program; without it, it is built.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[[ -n "${PLAT:-}" ]] || { cargo build --release --locked -p cli; PLAT="${CARGO_TARGET_DIR:-target}/release/plat"; }
export PLAT PYTHONDONTWRITEBYTECODE=1
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
step() { printf -- '-- %s (after %d s)\n' "$1" "$SECONDS"; }

step "Kubernetes"
command -v kubectl >/dev/null || { apt-get update -qq && apt-get install -qq --yes --no-install-recommends kubernetes-client; }
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check kubernetes-validate==1.37.0 python-hcl2==8.1.4
for kustomization in infra/kubernetes/*/; do
    name=$(basename "$kustomization")
    kubectl kustomize "$kustomization" > "$scratch/$name.yaml"
    "$scratch/venv/bin/kubernetes-validate" --strict --quiet "$scratch/$name.yaml"
    "$scratch/venv/bin/python" .ci/check-manifests.py "$scratch/$name.yaml"
done

step "metrics that dashboards and autoscaling ask for"
"$scratch/venv/bin/python" .ci/check-dashboards.py

step "Terraform"
if command -v terraform >/dev/null; then
    export TF_CLI_CONFIG_FILE=/dev/null CHECKPOINT_DISABLE=1
    terraform fmt -check -diff -recursive infra/terraform
    # Only the policies need no provider; of the rest the syntax is checked, and that it refers to nothing that is not there.
    cp -r infra/terraform/policies "$scratch/policies"
    terraform -chdir="$scratch/policies" init -backend=false -input=false >/dev/null
    terraform -chdir="$scratch/policies" validate
    terraform -chdir="$scratch/policies" test
    "$scratch/venv/bin/python" .ci/check-terraform.py infra/terraform
else
    echo "skipped: no terraform here, and nowhere to install it from"
fi

step "Slurm"
.ci/slurm.sh
step "done"
