"""Controls the cluster of docker-compose.yml for infra/chaos/run.py: starts it on a new store for each case, submits jobs, reads their
status, and changes objects below the store's API. Requires root: only a kill -9 from the host makes docker restart a container."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
PROJECT = "plat-chaos"
# The pool in which Ceph's S3 gateway stores objects.
POOL = "default.rgw.buckets.data"
USER = 10001


class StepFailed(Exception):
    """A step of the test itself failed, not the behaviour under test."""


class TooLate(StepFailed):
    """The job ended before the fault."""


def run(*words, check=True, env=None, data=None, timeout=180):
    """Runs a command and returns its standard output as bytes."""
    try:
        done = subprocess.run(words, input=data, capture_output=True, env=env, timeout=timeout)
    except subprocess.TimeoutExpired:
        raise StepFailed(f"{' '.join(words)}: timed out after {timeout} s") from None
    if check and done.returncode != 0:
        raise StepFailed(f"{' '.join(words)}: {done.returncode}: {done.stderr.decode(errors='replace')[-2000:]}")
    return done.stdout


def docker(*words, **options):
    return run("docker", *words, **options)


class Cluster:
    """The cluster. Only one can run at a time, as its name is fixed."""

    def __init__(self, capture, scratch, workers, lease_seconds, checkpoint_seconds, pages):
        self.pages = pages
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
        """Restarts everything on this store, except the object server if it already runs."""
        self.env["PLAT_STORE"] = store
        self.compose("rm", "--stop", "--force", "worker", "coordinator", "standby", "certificates", "dashboard")
        self.compose("up", "--detach", "--no-build", "--wait", "coordinator", "standby", "worker")

    def watch(self):
        """Starts the dashboard and a browser that watches it; returns the browser's process."""
        self.compose("up", "--detach", "--no-build", "--no-deps", "dashboard")
        token = docker("exec", self.containers("dashboard")[0], "cat", "/cluster/token").decode().strip()
        env = self.env | {"URL": f"https://localhost:{self.env.get('DASHBOARD_PORT', '7288')}", "TOKEN": token}
        words = ["node", str(self.pages / "tests/compose.mjs")]
        return subprocess.Popen(words, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def end(self):
        self.compose("--profile", "*", "down", "--volumes", "--timeout", "5", check=False)

    def containers(self, service):
        return self.compose("ps", "--quiet", "--status", "running", service).decode().split()

    def client(self, *words):
        """Starts a client process."""
        files = ["-f", str(REPOSITORY / "docker-compose.yml"), "-f", str(REPOSITORY / "infra/chaos/chaos.yml")]
        words = ["docker", "compose", "--project-name", PROJECT, *files, "run", "--rm", "--no-TTY", "--no-deps", "--quiet-pull", *words]
        return subprocess.Popen(words, env=self.env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def submit(self, out, plan):
        return self.client("client", "submit", "/capture", "--wait", "--out", f"/out/{out}", "--json", *plan)

    def model(self, out):
        """The merged model's bytes; None if there is none."""
        path = self.models / out / "merged.ply"
        return path.read_bytes() if path.is_file() else None

    def ask(self, *words, within=30):
        """Runs a client command in a coordinator's container until it succeeds; returns its answer."""
        until = time.monotonic() + within
        while True:
            for service in ("coordinator", "standby"):
                for container in self.containers(service):
                    words_there = ["exec", container, "plat", "--config", "/cluster/plat.toml", *words, "--json", "--quiet"]
                    try:
                        return json.loads(docker(*words_there, timeout=20))
                    except (StepFailed, ValueError) as error:
                        last = error
            if time.monotonic() > until:
                raise StepFailed(f"no answer to plat {' '.join(words)}: {last}")
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
        """The containers of the leader and of the standby."""
        until = time.monotonic() + within
        while time.monotonic() < until:
            both = self.containers("coordinator") + self.containers("standby")
            for container in both:
                if self.leads(container) and len(both) == 2:
                    return container, next(other for other in both if other != container)
            time.sleep(0.2)
        raise StepFailed("no coordinator leads, or one of the two is not running")

    def worker_of(self, task):
        """The container of a task's worker. A worker's name starts with its host name, which is the container's id."""
        found = [of for of in self.containers("worker") if task["worker"].startswith(of[:12])]
        return found[0] if found else None

    def logs(self):
        services = ["store", "bucket", "certificates", "coordinator", "standby", "worker", "dashboard"]
        return self.compose("logs", "--no-color", "--tail", "40", *services, check=False).decode(errors="replace")

    def rados(self, *words, **options):
        store = self.containers("store")[0]
        return docker("exec", "--interactive", store, "rados", "--pool", POOL, *words, **options)

    def objects(self, folder):
        """The RADOS names of the objects in a folder of the store."""
        prefix = self.env["PLAT_STORE"].split("/", 3)[3]
        return [name for name in self.rados("ls").decode().split("\n") if f"_{prefix}/{folder}" in name]


def kill(container):
    """kill -9, after which docker restarts the container by its policy."""
    os.kill(int(docker("inspect", "--format", "{{.State.Pid}}", container)), signal.SIGKILL)


def disconnect(container):
    """Disconnects a container from the cluster's network."""
    docker("network", "disconnect", f"{PROJECT}_cluster", container)


def reconnect(container):
    """Reconnects a container under its former name."""
    name = docker("inspect", "--format", "{{.Config.Hostname}}", container).decode().strip()
    docker("network", "connect", "--alias", name, f"{PROJECT}_cluster", container)
