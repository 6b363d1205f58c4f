"""Whether each container of rendered manifests is kept small and unprivileged, and whether plat knows the arguments that it is started with."""

import os
import subprocess
import sys

import yaml


def container_faults(kind, pod, container):
    security, limits = container.get("securityContext", {}), container.get("resources", {}).get("limits", {})
    wanted = {
        "runs as no root": pod.get("securityContext", {}).get("runAsNonRoot"),
        "has a seccomp profile": pod.get("securityContext", {}).get("seccompProfile"),
        "has a read-only root file system": security.get("readOnlyRootFilesystem"),
        "cannot gain privileges": security.get("allowPrivilegeEscalation") is False,
        "drops all capabilities": security.get("capabilities", {}).get("drop") == ["ALL"],
        "has a limit of memory": limits.get("memory"),
        "has no token of Kubernetes": pod.get("automountServiceAccountToken") is False,
    }
    faults = [f"not: {what}" for what, holds in wanted.items() if not holds]
    # Files and names of the cluster are not here, so it must stop at one of those and at nothing else.
    arguments = [word.replace("$(PLAT_STORE)", "s3://bucket/prefix") for word in container["args"]]
    said = subprocess.run([os.environ["PLAT"], *arguments], capture_output=True, text=True, timeout=60)
    if said.returncode != 2 or "/cluster/" not in said.stderr + said.stdout and "/secrets/" not in said.stderr:
        faults.append(f"plat {' '.join(arguments)}: {said.returncode}: {said.stderr.strip()}")
    return [f"{kind}, {container['name']}: {fault}" for fault in faults]


def main(path):
    with open(path) as file:
        documents = [document for document in yaml.safe_load_all(file) if document]
    pods = [(d["kind"], d["spec"]["template"]["spec"]) for d in documents if "template" in d.get("spec", {})]
    faults = [fault for kind, pod in pods for container in pod["containers"] for fault in container_faults(kind, pod, container)]
    print("\n".join(faults) or f"{len(documents)} objects, {len(pods)} kinds of pods")
    return 1 if faults or len(pods) < 2 else 0


sys.exit(main(sys.argv[1]))
