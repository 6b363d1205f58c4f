#!/usr/bin/env python3
"""Breaks a cluster in every way that clusters break while it works, and holds its model to the bytes that one undisturbed process makes
of the same plan.

    infra/chaos/run.py --capture FOLDER [--seeds 0..20] [--cases kill-worker,corrupt] [--out LINES.jsonl]

The images must be there (.ci/chaos.sh makes them). When a case strikes, whom, and for how long follows from its seed. One line a case;
exit code 1 if a model differs, or does not come to be.
"""

import argparse
import hashlib
import json
import random
import subprocess
import sys
import tempfile
import time
from datetime import datetime
from pathlib import Path

from cluster import PROJECT, USER, Cluster, Trouble, cut, docker, kill, mend

PLAN = ["--blocks", "tree", "--levels", "1", "--steps", "900", "--downscale", "4", "--backend", "cpu"]
LEASE_SECONDS = 2
CHECKPOINT_SECONDS = 1
# A job that takes longer than this hangs.
PATIENCE = 180


def calm(cluster, job, chance, about):
    """Nothing happens."""


def kill_worker(cluster, job, chance, about):
    worker = at_work(cluster, chance)
    kill(worker)
    about["lost_seconds_at_most"] = unsaved(cluster, time.time())


def kill_leader(cluster, job, chance, about):
    leader, other = cluster.coordinators()
    kill(leader)
    about["takeover_seconds"] = until_led(cluster, [other, leader])


def cut_worker(cluster, job, chance, about):
    worker = at_work(cluster, chance)
    cut(worker)
    time.sleep(away(chance))
    mend(worker)


def cut_leader(cluster, job, chance, about):
    leader, other = cluster.coordinators()
    cut(leader)
    about["takeover_seconds"] = until_led(cluster, [other])
    mend(leader)


def pause_worker(cluster, job, chance, about):
    worker = at_work(cluster, chance)
    docker("pause", worker)
    time.sleep(away(chance))
    docker("unpause", worker)


def pause_leader(cluster, job, chance, about):
    leader, other = cluster.coordinators()
    docker("pause", leader)
    about["takeover_seconds"] = until_led(cluster, [other])
    docker("unpause", leader)


def fill_disk(cluster, job, chance, about):
    """The store's disk is full for a while."""
    filled = f"cat /dev/zero > /shared/filler; sleep {away(chance):.1f}; rm /shared/filler"
    image = cluster.env.get("PLAT_IMAGE", "plat:latest")
    volume = f"{PROJECT}_shared:/shared"
    docker("run", "--rm", "--network", "none", "--user", str(USER), "--volume", volume, "--entrypoint", "sh", image, "-c", filled)


def corrupt(cluster, job, chance, about):
    """One byte of a result that all later tasks start from, on the store's disk, while the job is paused."""
    record = cluster.objects("names/results/")[0]
    artefact = cluster.rados("get", record, "-").hex()
    [damaged] = cluster.objects(f"artefacts/{artefact[:2]}/{artefact}")
    data = bytearray(cluster.rados("get", damaged, "-"))
    data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    cluster.rados("put", damaged, "-", data=bytes(data))
    about["damaged"] = damaged
    cluster.ask("resume", "1")


CASES = {
    "calm": calm,
    "kill-worker": kill_worker,
    "kill-leader": kill_leader,
    "cut-worker": cut_worker,
    "cut-leader": cut_leader,
    "pause-worker": pause_worker,
    "pause-leader": pause_leader,
    "fill-disk": fill_disk,
    "corrupt": corrupt,
}


def away(chance):
    """Seconds, longer than a lease."""
    return LEASE_SECONDS + chance.uniform(0.5, 4)


def at_work(cluster, chance):
    """A worker that has a task in hand."""
    until = time.monotonic() + 20
    while time.monotonic() < until:
        tasks = cluster.ask("status", "1")["running"]
        workers = [worker for worker in map(cluster.worker_of, tasks) if worker]
        if workers:
            return chance.choice(workers)
    raise Trouble("no worker has a task")


def until_led(cluster, candidates):
    """Seconds until one of these leads."""
    began = time.monotonic()
    while time.monotonic() - began < 60:
        if any(cluster.leads(container) for container in candidates):
            return round(time.monotonic() - began, 2)
        time.sleep(0.1)
    raise Trouble("nobody took over within a minute")


def unsaved(cluster, now):
    """Seconds of work that a checkpoint does not hold: of the tasks under way, the one that was saved the longest ago."""
    ages = [0.0]
    for name in cluster.objects("names/checkpoints/"):
        said = cluster.rados("stat", name, check=False).decode()
        if ", size 0" not in said and " mtime " in said:
            ages.append(now - datetime.fromisoformat(said.split(" mtime ")[1].split(",")[0]).timestamp())
    return round(max(ages), 1)


def wait_for(cluster, job, done):
    """Until so many tasks are done, and the job is not."""
    while True:
        if job.poll() is not None:
            raise Trouble(f"the job was over before it was struck: {job.stderr.read().decode()[-500:]}")
        try:
            status = cluster.ask("status", "1", within=1)
        except Trouble:
            continue
        if status["done"] >= done and (status["running"] or status["state"] == "paused"):
            return status


def finish(job, about):
    """Its exit code, and what it said last if that is not 0."""
    try:
        _, said = job.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        job.terminate()
        said = b"it hangs"
    if job.returncode != 0:
        about["said"] = said.decode(errors="replace").strip().split("\n")[-1]
    return job.returncode


def rehearse(cluster, case, seed, wanted):
    """One case: a line of results."""
    chance = random.Random(f"{case} {seed}")
    about = {"case": case, "seed": seed}
    out = f"{case}-{seed}"
    cluster.start(f"file:///shared/{out}" if case == "fill-disk" else f"s3://plat/{out}")
    began = time.monotonic()
    job = cluster.submit(out, PLAN)
    if case == "corrupt":
        wait_for(cluster, job, 0)
        cluster.ask("pause", "1")
        wait_for(cluster, job, 1)
    elif case != "calm":
        status = wait_for(cluster, job, 0)
        if (done := chance.randrange(status["tasks"] - 1)) > 0:
            wait_for(cluster, job, done)
        about["done_before"] = done
        time.sleep(chance.uniform(0, 0.5))
    CASES[case](cluster, job, chance, about)
    code = finish(job, about)
    if code != 0 and case == "corrupt":
        about["recovery"] = recover(cluster, out, about)
    about["seconds"] = round(time.monotonic() - began, 1)
    about["identical"] = hashlib.sha256(cluster.model(out) or b"").digest() == wanted
    return about


def recover(cluster, out, about):
    """What it takes until the job succeeds: the same job again, or the damaged object deleted before."""
    for remedy in ("submitted again", "object deleted, submitted again"):
        if remedy.startswith("object"):
            cluster.rados("rm", about["damaged"])
        if finish(cluster.submit(out, PLAN), {}) == 0:
            return remedy
    return None


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seeds", default="0..1", help="from..to, the last not among them")
    parser.add_argument("--cases", default=",".join(CASES), help="some of " + ", ".join(CASES))
    parser.add_argument("--capture", type=Path, required=True, help="a folder of photos, as plat train takes it")
    parser.add_argument("--out", type=Path, help="append a line of JSON for each case")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--keep", action="store_true", help="leave the cluster as it is after the last case")
    chosen = parser.parse_args()
    chosen.cases = chosen.cases.split(",")
    if unknown := [case for case in chosen.cases if case not in CASES]:
        parser.error(f"--cases: {', '.join(unknown)}: choose from {', '.join(CASES)}")
    try:
        chosen.seeds = range(*map(int, chosen.seeds.split("..")))
    except (ValueError, TypeError):
        parser.error("--seeds: give them as 0..20")
    return chosen


def note(line, out):
    text = ", ".join(f"{name} {value}" for name, value in line.items() if name not in ("case", "seed", "identical"))
    verdict = {True: "identical", False: "DIFFERENT", None: ""}[line.get("identical")]
    print(f"{line['case']:<13} seed {line['seed']:<3} {verdict}  {text}", flush=True)
    if out:
        with out.open("a") as lines:
            lines.write(json.dumps(line) + "\n")


def main():
    chosen = arguments()
    failures = 0
    with tempfile.TemporaryDirectory(prefix="plat-chaos-") as scratch:
        scratch = Path(scratch)
        scratch.chmod(0o755)
        cluster = Cluster(chosen.capture.resolve(), scratch, chosen.workers, LEASE_SECONDS, CHECKPOINT_SECONDS)
        alone = lambda *words: finish(cluster.client("--entrypoint", "plat", "client", *words), about) == 0
        try:
            about = {"case": "start", "seed": "-"}
            cluster.end()
            began = time.monotonic()
            cluster.start("s3://plat/start")
            note(about | {"seconds": round(time.monotonic() - began, 1)}, None)
            about = {"case": "one process", "seed": "-"}
            began = time.monotonic()
            if not alone("train", "/capture", "--out", "/out/alone", "--workers", "1", "--threads", "2", *PLAN):
                raise Trouble(about["said"])
            note(about | {"seconds": round(time.monotonic() - began, 1)}, None)
            wanted = hashlib.sha256(cluster.model("alone")).digest()
            for seed in chosen.seeds:
                for case in chosen.cases:
                    try:
                        line = rehearse(cluster, case, seed, wanted)
                    except Trouble as trouble:
                        line = {"case": case, "seed": seed, "identical": False, "said": str(trouble)}
                    note(line, chosen.out)
                    if not line["identical"]:
                        failures += 1
                        print(cluster.logs(), file=sys.stderr)
        except Trouble as trouble:
            print(cluster.logs(), file=sys.stderr)
            print(f"{about['case']}: {trouble}", file=sys.stderr)
            failures += 1
        finally:
            if not chosen.keep:
                cluster.end()
    count = len(chosen.seeds) * len(chosen.cases)
    print(f"{count} cases, {failures} of which failed" if failures else f"{count} cases, all identical to one process")
    return min(failures, 1)


if __name__ == "__main__":
    sys.exit(main())
