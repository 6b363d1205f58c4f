#!/usr/bin/env python3
"""Injects faults into a running cluster and compares its model with the bytes that a single undisturbed process makes of the same plan.

    infra/chaos/run.py --capture FOLDER --pages FOLDER [--seeds 0..20] [--cases kill-worker,corrupt] [--out LINES.jsonl]

The images must exist (.ci/chaos.sh builds them). A case's seed determines when it strikes, its target and its duration. Prints one line
per case; exit code 1 if a model differs or a job fails.
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

from cluster import PROJECT, USER, Cluster, StepFailed, TooLate, disconnect, docker, kill, reconnect

PLAN = ["--blocks", "tree", "--levels", "1", "--steps", "1800", "--downscale", "4", "--backend", "cpu"]
LEASE_SECONDS = 2
CHECKPOINT_SECONDS = 1
# How often a case is tried whose job ends before the fault, as on a machine where docker is slow.
TRIES = 3
# A job that takes longer than this counts as hung, seconds.
JOB_TIMEOUT = 180


def calm(cluster, job, chance, about):
    """No fault."""


def kill_worker(cluster, job, chance, about):
    worker = busy_worker(cluster, job, chance)
    kill(worker)
    about["lost_seconds_at_most"] = unsaved_seconds(cluster, time.time())


def kill_leader(cluster, job, chance, about):
    leader, other = cluster.coordinators()
    kill(leader)
    about["takeover_seconds"] = takeover_seconds(cluster, [other, leader])


def cut_worker(cluster, job, chance, about):
    worker = busy_worker(cluster, job, chance)
    disconnect(worker)
    time.sleep(outage_seconds(chance))
    reconnect(worker)


def cut_leader(cluster, job, chance, about):
    leader, other = cluster.coordinators()
    disconnect(leader)
    about["takeover_seconds"] = takeover_seconds(cluster, [other])
    reconnect(leader)


def pause_worker(cluster, job, chance, about):
    worker = busy_worker(cluster, job, chance)
    docker("pause", worker)
    time.sleep(outage_seconds(chance))
    docker("unpause", worker)


def pause_leader(cluster, job, chance, about):
    leader, other = cluster.coordinators()
    docker("pause", leader)
    about["takeover_seconds"] = takeover_seconds(cluster, [other])
    docker("unpause", leader)


def fill_disk(cluster, job, chance, about):
    """Fills the store's disk for a while."""
    filled = f"cat /dev/zero > /shared/filler; sleep {outage_seconds(chance):.1f}; rm /shared/filler"
    image = cluster.env.get("PLAT_IMAGE", "plat:latest")
    volume = f"{PROJECT}_shared:/shared"
    docker("run", "--rm", "--network", "none", "--user", str(USER), "--volume", volume, "--entrypoint", "sh", image, "-c", filled)


def corrupt(cluster, job, chance, about):
    """Flips a bit of the root's result on the store's disk while the job is paused. All later tasks start from that result."""
    record = cluster.objects("names/results/")[0]
    artefact = cluster.rados("get", record, "-").hex()
    [damaged] = cluster.objects(f"artefacts/{artefact[:2]}/{artefact}")
    data = bytearray(cluster.rados("get", damaged, "-"))
    data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    cluster.rados("put", damaged, "-", data=bytes(data))
    about["damaged"] = damaged
    cluster.ask("resume", "1")


def watched(cluster, job, chance, about):
    """A browser watches the dashboard while a worker is silent and the leader dies. Needs --pages."""
    watcher = cluster.watch()
    paused = None
    for line in watcher.stdout:
        match line.decode().strip().removeprefix("next: "):
            case "pause":
                docker("pause", paused := busy_worker(cluster, job, chance))
            case "go on":
                docker("unpause", paused)
            case "kill":
                kill(cluster.coordinators()[0])
            case said:
                about["watcher"] = said
    if watcher.wait() != 0:
        raise StepFailed(watcher.stderr.read().decode()[-1500:])


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
    "watched": watched,
}


def outage_seconds(chance):
    """Duration of an outage: longer than a lease."""
    return LEASE_SECONDS + chance.uniform(0.5, 4)


def busy_worker(cluster, job, chance):
    """A worker that executes a task."""
    until = time.monotonic() + 20
    while time.monotonic() < until:
        tasks = cluster.ask("status", "1")["running"]
        workers = [worker for worker in map(cluster.worker_of, tasks) if worker]
        if workers:
            return chance.choice(workers)
    raise (TooLate if job.poll() == 0 else StepFailed)("no worker has a task")


def takeover_seconds(cluster, candidates):
    """Waits until one of these leads; returns the seconds that took."""
    began = time.monotonic()
    while time.monotonic() - began < 60:
        if any(cluster.leads(container) for container in candidates):
            return round(time.monotonic() - began, 2)
        time.sleep(0.1)
    raise StepFailed("no coordinator took over within a minute")


def unsaved_seconds(cluster, now):
    """Age of the oldest checkpoint of the running tasks, seconds."""
    ages = [0.0]
    for name in cluster.objects("names/checkpoints/"):
        said = cluster.rados("stat", name, check=False).decode()
        if ", size 0" not in said and " mtime " in said:
            ages.append(now - datetime.fromisoformat(said.split(" mtime ")[1].split(",")[0]).timestamp())
    return round(max(ages), 1)


def wait_for(cluster, job, done):
    """Waits until this many tasks are done and the job still runs; returns the status."""
    while True:
        if job.poll() is not None:
            raise (TooLate if job.returncode == 0 else StepFailed)(f"the job ended before the fault: {job.stderr.read().decode()[-500:]}")
        try:
            status = cluster.ask("status", "1", within=1)
        except StepFailed:
            continue
        if status["done"] >= done and (status["running"] or status["state"] == "paused"):
            return status


def finish(job, about):
    """Waits for a client; returns its exit code, and records its last line of stderr if that is not 0."""
    try:
        _, stderr = job.communicate(timeout=JOB_TIMEOUT)
    except subprocess.TimeoutExpired:
        job.terminate()
        stderr = b"timed out"
    if job.returncode != 0:
        about["said"] = stderr.decode(errors="replace").strip().split("\n")[-1]
    return job.returncode


def run_case(cluster, case, seed, wanted, tries=1):
    """Runs one case; returns its line of results."""
    chance = random.Random(f"{case} {seed}")
    about = {"case": case, "seed": seed}
    out = f"{case}-{seed}" + (f"-{tries}" if tries > 1 else "")
    cluster.start(f"file:///shared/{out}" if case == "fill-disk" else f"s3://plat/{out}")
    began = time.monotonic()
    job = cluster.submit(out, PLAN)
    if case == "corrupt":
        wait_for(cluster, job, 0)
        cluster.ask("pause", "1")
        wait_for(cluster, job, 1)
    elif case not in ("calm", "watched"):
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
    if tries > 1:
        about["tries"] = tries
    about["identical"] = hashlib.sha256(cluster.model(out) or b"").digest() == wanted
    return about


def in_time(run):
    """The result of a case, run again if its job ended too early."""
    for tries in range(1, TRIES):
        try:
            return run(tries)
        except TooLate:
            pass
    return run(TRIES)


def recover(cluster, out, about):
    """The remedy after which the job succeeds: submitting it again, or deleting the damaged object first; None if neither helps."""
    for remedy in ("submitted again", "object deleted, submitted again"):
        if remedy.startswith("object"):
            cluster.rados("rm", about["damaged"])
        if finish(cluster.submit(out, PLAN), {}) == 0:
            return remedy
    return None


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seeds", default="0..1", help="from..to, without the last one")
    parser.add_argument("--cases", default=",".join(CASES), help="a subset of " + ", ".join(CASES))
    parser.add_argument("--capture", type=Path, required=True, help="a folder of photos, as plat train takes it")
    parser.add_argument("--out", type=Path, help="append a line of JSON for each case")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--pages", type=Path, help="the dashboard's folder with its packages installed, for the case watched")
    parser.add_argument("--keep", action="store_true", help="leave the cluster as it is after the last case")
    chosen = parser.parse_args()
    chosen.cases = chosen.cases.split(",")
    if unknown := [case for case in chosen.cases if case not in CASES]:
        parser.error(f"--cases: {', '.join(unknown)}: choose from {', '.join(CASES)}")
    if "watched" in chosen.cases and not chosen.pages:
        parser.error("the case watched needs --pages")
    try:
        chosen.seeds = range(*map(int, chosen.seeds.split("..")))
    except (ValueError, TypeError):
        parser.error("--seeds: give a range as 0..20")
    return chosen


def report(line, out):
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
        cluster = Cluster(chosen.capture.resolve(), scratch, chosen.workers, LEASE_SECONDS, CHECKPOINT_SECONDS, chosen.pages)
        alone = lambda *words: finish(cluster.client("--entrypoint", "plat", "client", *words), about) == 0
        try:
            about = {"case": "start", "seed": "-"}
            cluster.end()
            began = time.monotonic()
            cluster.start("s3://plat/start")
            report(about | {"seconds": round(time.monotonic() - began, 1)}, None)
            about = {"case": "one process", "seed": "-"}
            began = time.monotonic()
            if not alone("train", "/capture", "--out", "/out/alone", "--workers", "1", "--threads", "2", *PLAN):
                raise StepFailed(about["said"])
            report(about | {"seconds": round(time.monotonic() - began, 1)}, None)
            wanted = hashlib.sha256(cluster.model("alone")).digest()
            for seed in chosen.seeds:
                for case in chosen.cases:
                    try:
                        line = in_time(lambda tries: run_case(cluster, case, seed, wanted, tries))
                    except StepFailed as error:
                        line = {"case": case, "seed": seed, "identical": False, "said": str(error)}
                    report(line, chosen.out)
                    if not line["identical"]:
                        failures += 1
                        print(cluster.logs(), file=sys.stderr)
        except StepFailed as error:
            print(cluster.logs(), file=sys.stderr)
            print(f"{about['case']}: {error}", file=sys.stderr)
            failures += 1
        finally:
            if not chosen.keep:
                cluster.end()
    count = len(chosen.seeds) * len(chosen.cases)
    print(f"{count} cases, {failures} of which failed" if failures else f"{count} cases, all identical to one process")
    return min(failures, 1)


if __name__ == "__main__":
    sys.exit(main())
