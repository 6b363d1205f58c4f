"""The cluster of docker-compose.yml as infra/chaos/run.py breaks it: starts it on a store of its own for each case, submits, looks,
and reaches below the store. Takes root, as only the host can kill -9 what docker is to start again."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
PROJECT = "plat-chaos"
# Where Ceph's S3 gateway keeps the bytes of objects.
POOL = "default.rgw.buckets.data"
USER = 10001


class Trouble(Exception):
    """A step of the rehearsal itself failed, not what is rehearsed."""


def run(*words, check=True, env=None, data=None, timeout=180):
    """A command's standard output, as bytes."""
    try:
        done = subprocess.run(words, input=data, capture_output=True, env=env, timeout=timeout)
    except subprocess.TimeoutExpired:
        raise Trouble(f"{' '.join(words)}: no end after {timeout} s") from None
    if check and done.returncode != 0:
        raise Trouble(f"{' '.join(words)}: {done.returncode}: {done.stderr.decode(errors='replace')[-2000:]}")
    return done.stdout


def docker(*words, **options):
    return run("docker", *words, **options)


class Cluster:
    """One at a time: it has one name."""

    def __init__(self, capture, scratch, workers, lease_seconds, checkpoint_seconds):
        self.models = scratch / "models"
        self.models.mkdir()
        os.chown(self.models, USER, USER)
        settings = {
            "CAPTURE": capture, "MODELS": self.models, "WORKERS": workers, "WORKER_THREADS": 1, "WORKER_MEMORY": "2g",
            "LEASE_SECONDS": lease_seconds, "CHECKPOINT_SECONDS": checkpoint_seconds,
        }
        self.env = dict(os.environ) | {name: str(value) for name, value in settings.items()}

    def compose(self, *words, **options):
        files = ["-f", REPOSITORY / "docker-compose.yml", "-f", REPOSITORY / "infra/chaos/chaos.yml"]
        words = ["docker", "compose", "--project-name", PROJECT, *map(str, files), *words]
        return run(*words, env=self.env, **options)

    def start(self, store):
        """Everything anew on this store, but for the server of objects, which may run on."""
        self.env["PLAT_STORE"] = store
        self.compose("rm", "--stop", "--force", "worker", "coordinator", "standby", "certificates")
        self.compose("up", "--detach", "--no-build", "--wait", "coordinator", "standby", "worker")

    def end(self):
        self.compose("--profile", "*", "down", "--volumes", "--timeout", "5", check=False)

    def containers(self, service):
        return self.compose("ps", "--quiet", "--status", "running", service).decode().split()

    def client(self, *words):
        """A client's process, under way."""
        files = ["-f", str(REPOSITORY / "docker-compose.yml"), "-f", str(REPOSITORY / "infra/chaos/chaos.yml")]
        words = ["docker", "compose", "--project-name", PROJECT, *files, "run", "--rm", "--no-TTY", "--no-deps", "--quiet-pull", *words]
        return subprocess.Popen(words, env=self.env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def submit(self, out, plan):
        return self.client("client", "submit", "/capture", "--wait", "--out", f"/out/{out}", "--json", *plan)

    def model(self, out):
        """The merged model's bytes, or nothing."""
        path = self.models / out / "merged.ply"
        return path.read_bytes() if path.is_file() else None

    def ask(self, *words, within=30):
        """A client's answer, asked from beside a coordinator until there is one."""
        until = time.monotonic() + within
        while True:
            for service in ("coordinator", "standby"):
                for container in self.containers(service):
                    words_there = ["exec", container, "plat", "--config", "/cluster/plat.toml", *words, "--json", "--quiet"]
                    try:
                        return json.loads(docker(*words_there, timeout=20))
                    except (Trouble, ValueError) as error:
                        last = error
            if time.monotonic() > until:
                raise Trouble(f"no answer to plat {' '.join(words)}: {last}")
            time.sleep(0.1)

    def leads(self, container):
        """Whether the coordinator in this container leads."""
        address = ["--coordinator", "https://localhost:7287"]
        words = ["docker", "exec", container, "plat", "--config", "/cluster/plat.toml", "jobs", "--quiet", *address]
        try:
            return subprocess.run(words, capture_output=True, timeout=20).returncode == 0
        except subprocess.TimeoutExpired:
            return False

    def coordinators(self, within=30):
        """The one that leads, and the other."""
        until = time.monotonic() + within
        while time.monotonic() < until:
            both = self.containers("coordinator") + self.containers("standby")
            for container in both:
                if self.leads(container) and len(both) == 2:
                    return container, next(other for other in both if other != container)
            time.sleep(0.2)
        raise Trouble("no coordinator leads, or one of the two is away")

    def worker_of(self, task):
        """The container of the worker that has a task: a worker is called by its host's name, which is the container's."""
        found = [of for of in self.containers("worker") if task["worker"].startswith(of[:12])]
        return found[0] if found else None

    def logs(self):
        services = ["store", "bucket", "certificates", "coordinator", "standby", "worker"]
        return self.compose("logs", "--no-color", "--tail", "40", *services, check=False).decode(errors="replace")

    def rados(self, *words, **options):
        store = self.containers("store")[0]
        return docker("exec", "--interactive", store, "rados", "--pool", POOL, *words, **options)

    def objects(self, folder):
        """Objects of the store's folder, as they are called below it."""
        prefix = self.env["PLAT_STORE"].split("/", 3)[3]
        return [name for name in self.rados("ls").decode().split("\n") if f"_{prefix}/{folder}" in name]


def kill(container):
    """kill -9, after which docker starts it again as its policy says."""
    os.kill(int(docker("inspect", "--format", "{{.State.Pid}}", container)), signal.SIGKILL)


def cut(container):
    """Off the cluster's network."""
    docker("network", "disconnect", f"{PROJECT}_cluster", container)


def mend(container):
    """Back on it, under the name it had."""
    name = docker("inspect", "--format", "{{.Config.Hostname}}", container).decode().strip()
    docker("network", "connect", "--alias", name, f"{PROJECT}_cluster", container)
