"""Checks that each container of rendered manifests is limited and unprivileged, and that plat accepts its arguments."""

import os
import subprocess
import sys

import yaml


def container_faults(kind, pod, container):
    security, limits = container.get("securityContext", {}), container.get("resources", {}).get("limits", {})
    wanted = {
        "runs as non-root": pod.get("securityContext", {}).get("runAsNonRoot"),
        "has a seccomp profile": pod.get("securityContext", {}).get("seccompProfile"),
        "has a read-only root file system": security.get("readOnlyRootFilesystem"),
        "cannot gain privileges": security.get("allowPrivilegeEscalation") is False,
        "drops all capabilities": security.get("capabilities", {}).get("drop") == ["ALL"],
        "has a memory limit": limits.get("memory"),
        "has no Kubernetes token": pod.get("automountServiceAccountToken") is False,
    }
    faults = [f"violated: {rule}" for rule, holds in wanted.items() if not holds]
    # The cluster's files do not exist here, so plat must fail at one of them and at nothing else.
    arguments = [word.replace("$(PLAT_STORE)", "s3://bucket/prefix") for word in container["args"]]
    done = subprocess.run([os.environ["PLAT"], *arguments], capture_output=True, text=True, timeout=60)
    if done.returncode != 2 or "/cluster/" not in done.stderr + done.stdout and "/secrets/" not in done.stderr:
        faults.append(f"plat {' '.join(arguments)}: {done.returncode}: {done.stderr.strip()}")
    return [f"{kind}, {container['name']}: {fault}" for fault in faults]


def main(path):
    with open(path) as file:
        documents = [document for document in yaml.safe_load_all(file) if document]
    pods = [(d["kind"], d["spec"]["template"]["spec"]) for d in documents if "template" in d.get("spec", {})]
    faults = [fault for kind, pod in pods for container in pod["containers"] for fault in container_faults(kind, pod, container)]
    print("\n".join(faults) or f"{len(documents)} objects, {len(pods)} kinds of pods")
    return 1 if faults or len(pods) < 2 else 0


sys.exit(main(sys.argv[1]))
