"""Checks that dashboards and the autoscaler query only metrics that docs/src/metrics.md lists, and only provisioned data sources."""

import json
import re
import sys
from pathlib import Path

import yaml

OBSERVABILITY = Path("infra/observability")
sources = {source["uid"] for source in yaml.safe_load((OBSERVABILITY / "grafana/datasources/plat.yaml").read_text())["datasources"]}
for file in sorted(OBSERVABILITY.glob("*.yaml")):
    yaml.safe_load(file.read_text())
faults, queried = [], set()
for file in sorted((OBSERVABILITY / "grafana/dashboards").glob("*.json")):
    board = json.loads(file.read_text())
    ids = [panel["id"] for panel in board["panels"]]
    if len(set(ids)) < len(ids):
        faults.append(f"{file}: two panels have the same id")
    for panel in board["panels"]:
        if panel["datasource"]["uid"] not in sources:
            faults.append(f"{file}: '{panel['title']}' queries {panel['datasource']['uid']}, which is not provisioned")
        for target in panel["targets"]:
            queried |= set(re.findall(r"\bplat_\w+", target.get("expr", "")))
queried |= set(re.findall(r"\bplat_tasks_(?:ready|leased)\b", Path("infra/kubernetes/base/worker.yaml").read_text()))
listed = Path("docs/src/metrics.md")
if listed.is_file():
    known = set(re.findall(r"\bplat_\w+", listed.read_text()))
    # Series of histograms and counters have suffixes.
    base = lambda name: re.sub(r"_(bucket|sum|count|total)$", "", name)
    known |= {base(name) for name in known}
    faults += [f"{name}: not in {listed}" for name in sorted(queried) if name not in known and base(name) not in known]
else:
    print(f"{listed} does not exist: metric names are not checked")
print("\n".join(faults) or f"{len(queried)} metrics queried")
sys.exit(1 if faults else 0)
