"""Whether dashboards and the autoscaler ask for metrics that docs/src/metrics.md lists, and for data sources that are provisioned."""

import json
import re
import sys
from pathlib import Path

import yaml

OBSERVABILITY = Path("infra/observability")
sources = {source["uid"] for source in yaml.safe_load((OBSERVABILITY / "grafana/datasources/plat.yaml").read_text())["datasources"]}
for file in sorted(OBSERVABILITY.glob("*.yaml")):
    yaml.safe_load(file.read_text())
faults, asked = [], set()
for file in sorted((OBSERVABILITY / "grafana/dashboards").glob("*.json")):
    board = json.loads(file.read_text())
    ids = [panel["id"] for panel in board["panels"]]
    if len(set(ids)) < len(ids):
        faults.append(f"{file}: two panels have the same id")
    for panel in board["panels"]:
        if panel["datasource"]["uid"] not in sources:
            faults.append(f"{file}: '{panel['title']}' asks {panel['datasource']['uid']}, which is not provisioned")
        for target in panel["targets"]:
            asked |= set(re.findall(r"\bplat_\w+", target.get("expr", "")))
asked |= set(re.findall(r"\bplat_tasks_(?:ready|leased)\b", Path("infra/kubernetes/base/worker.yaml").read_text()))
listed = Path("docs/src/metrics.md")
if listed.is_file():
    known = set(re.findall(r"\bplat_\w+", listed.read_text()))
    # A histogram's parts, and counters with their suffix.
    base = lambda name: re.sub(r"_(bucket|sum|count|total)$", "", name)
    known |= {base(name) for name in known}
    faults += [f"{name}: not in {listed}" for name in sorted(asked) if name not in known and base(name) not in known]
else:
    print(f"{listed} is not there yet: the names of metrics are not checked")
print("\n".join(faults) or f"{len(asked)} metrics asked for")
sys.exit(1 if faults else 0)
