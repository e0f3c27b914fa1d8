"""The compose file: what docker-compose says of it, and its very commands as processes on hosts of their own."""

import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import Scene
from namespaces import Host, network

from tract_dask.cluster import forkserver
from tract_dask.cluster.certificates import make_certificates
from tract_dask.store.results import open_results

pytestmark = pytest.mark.timeout(600)  # many processes start: minutes where a machine is busy

ROOT = Path(__file__).parents[2]
SHOTS = ("certs", "tokens")
"""Parts that do one thing and end."""

STRANGER = "stranger"
"""A host that is no part of the file."""


def substituted(text: str, variables: dict[str, str]) -> str:
    """``${NAME:-default}``, as compose replaces it."""
    return re.sub(r"\$\{(\w+):-([^}]*)\}", lambda found: variables.get(found[1]) or found[2], text)


def dockerfile_environment() -> dict[str, str]:
    """What ENV sets in the last stage."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8").split("\nFROM ")[-1].replace("\\\n", " ")
    (line,) = re.findall(r"^ENV (.*)$", text, re.MULTILINE)
    return dict(part.split("=", 1) for part in line.split())


@dataclass
class Deployment:
    """The parts of the compose file on their hosts, with folders in place of volumes."""

    parts: dict[str, dict]
    hosts: dict[str, Host]
    folder: Path
    processes: dict[str, subprocess.Popen] = field(default_factory=dict)

    def environment(self, part: dict) -> dict[str, str]:
        """The image's variables and the part's, and nothing else.

        Programs are those of this environment, and so are compiled kernels: in an empty cache they take a minute.
        """
        programs = f"{Path(sys.executable).parent}:{self.folder / 'bin'}:/usr/sbin:/usr/bin:/sbin:/bin"
        here = {"PATH": programs, "HOME": str(self.folder)}
        image = {name: value for name, value in dockerfile_environment().items() if name != "NUMBA_CACHE_DIR"}
        return image | part.get("environment", {}) | here

    def start(self, name: str, command: list[str], part: dict | None = None, host: str = "", **options):
        """Start a command with the volumes and the environment of a part."""
        part = part or self.parts[name]
        volumes = {}
        for volume in part.get("volumes", ()):
            source, place = volume.split(":")[:2]
            volumes[self.folder / "volumes" / source] = place
            (self.folder / "volumes" / source).mkdir(parents=True, exist_ok=True)
        log = (self.folder / f"{name}.log").open("a")
        streams = {"stdin": subprocess.DEVNULL, "stdout": log, "stderr": log} | options
        process = self.hosts[host or name].popen(command, volumes, self.environment(part), **streams)
        self.processes.setdefault(name, process)
        return process

    def finish(self, name: str, command: list[str], part: dict | None = None, host: str = "") -> tuple[int, str]:
        """Run a command to its end; return its exit code and what it printed."""
        process = self.start(name, command, part, host, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        said, _ = process.communicate(timeout=60)
        return process.returncode, said

    def wait_until_healthy(self, name: str, seconds: float = 120.0) -> str:
        """Repeat the part's own health check until it succeeds; return what it printed."""
        kind, *command = self.parts[name]["healthcheck"]["test"]
        assert kind == "CMD"
        deadline = time.monotonic() + seconds
        while True:
            code, said = self.finish(f"{name}-health", command, self.parts[name], name)
            if code == 0:
                return said
            log = (self.folder / f"{name}.log").read_text()[-3000:]
            assert self.processes[name].poll() is None, f"{name} has ended\n{log}"
            assert time.monotonic() < deadline, f"{name} is not healthy: {said}\n{log}"
            time.sleep(0.2)


@pytest.fixture(scope="module")
def parts() -> dict[str, dict]:
    variables = {"WORKER_MEMORY": "1500000000", "PUBLIC_HOST": "service"}
    text = substituted((ROOT / "docker-compose.yml").read_text(encoding="utf-8"), variables)
    return yaml.safe_load(text)["services"]


@pytest.fixture(scope="module")
def deployment(parts, tmp_path_factory) -> Iterator[Deployment]:
    """All parts of the file, started in the order of their dependencies."""
    folder = tmp_path_factory.mktemp("compose")
    (folder / "bin").mkdir()
    (folder / "bin" / "healthcheck").symlink_to(ROOT / "deploy" / "healthcheck")
    with ExitStack() as stack:
        hosts = stack.enter_context(network([*parts, STRANGER], folder))
        found = Deployment(parts, hosts, folder)
        for name in SHOTS:
            code, said = found.finish(name, parts[name]["command"])
            assert code == 0, said
        for name in ("scheduler", "worker", "service"):
            ahead = {other: item["condition"] for other, item in parts[name]["depends_on"].items()}
            assert set(ahead) <= {*SHOTS, *found.processes}
            found.start(name, parts[name]["command"])
            if name != "worker":
                found.wait_until_healthy(name)
        yield found


def test_docker_compose_takes_the_file():
    program = shutil.which("docker-compose")
    assert program, "docker-compose is missing (on Debian: apt-get install docker-compose)"
    done = subprocess.run([program, "config", "--quiet"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_limits_and_privileges(parts):
    worker = parts["worker"]
    assert f"--memory-limit={worker['mem_limit']}" in worker["command"]
    for part in parts.values():
        assert "privileged" not in part
        assert part["cap_drop"] == ["ALL"]
    for name in ("scheduler", "worker", "service"):
        assert parts[name]["restart"] == "unless-stopped"
        assert parts[name]["healthcheck"]
    seen = {volume.split(":")[0] for name in set(parts) - {"certs"} for volume in parts[name]["volumes"]}
    assert "authority" not in seen
    assert {name for name in parts if "state:/srv/state" in parts[name].get("volumes", ())} == {"tokens", "service"}


def test_the_image_sets_what_local_workers_get():
    assert forkserver.ENVIRONMENT.items() <= dockerfile_environment().items()


def test_job_runs_through_the_parts(deployment):
    movie = deployment.folder / "volumes" / "data" / "movie.npy"
    np.save(movie, Scene(n_frames=8).counts())
    # a client elsewhere: it has the certificate of the authority and a token, as a user would
    user = {"volumes": ["state:/srv/state", "certs:/srv/certs"]}
    at = ["--server", "https://service:8000", "--ca", "/srv/certs/ca.pem"]
    at += ["--token-file", "/srv/state/admin.token"]
    submit = ["tract-dask", "submit", "movie.npy", "--shard-mb", "1", "--watch", "--json", *at]
    process = deployment.start("user", submit, user, STRANGER, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    said, progress = process.communicate(timeout=240)
    assert process.returncode == 0, progress + (deployment.folder / "service.log").read_text()
    job = json.loads(said.strip().splitlines()[-1])
    assert job["state"] == "done"
    tracks = open_results(deployment.folder / "volumes" / "data" / job["output"] / "results.zarr")
    assert tracks.sizes["frame"] == 8
    health = json.loads(deployment.wait_until_healthy("service"))
    assert (health["status"], health["workers"]) == ("ok", 1)
    deployment.wait_until_healthy("worker")


def test_dask_dashboard_comes_through_the_service(deployment):
    token = (deployment.folder / "volumes" / "state" / "admin.token").read_text().strip()
    script = (
        "import httpx, ssl; context = ssl.create_default_context(cafile='/srv/certs/ca.pem')\n"
        "answer = httpx.get('https://service:8000/dask/status', verify=context,"
        f" headers={{'Authorization': 'Bearer {token}'}})\n"
        "print(answer.status_code, 'Dask' in answer.text)"
    )
    code, said = deployment.finish("page", [sys.executable, "-c", script], {"volumes": ["certs:/srv/certs"]}, STRANGER)
    assert (code, said.split()) == (0, ["200", "True"]), said


CONNECT = """
import sys
from tract_dask.cluster.connect import connect
from tract_dask.errors import ClusterError
from tract_dask.settings import ClusterSettings
for case in sys.argv[1:]:
    address, folder = case.split(",")
    try:
        with connect(ClusterSettings(scheduler=address, tls=folder or None), timeout_s=5) as client:
            print("connected", client.submit(sum, [1, 2]).result(timeout=20))
    except ClusterError as error:
        print("refused:", error)
"""


def test_client_is_refused_without_the_certificate(deployment):
    make_certificates(deployment.folder / "volumes" / "others")
    part = {"volumes": ["certs:/srv/certs", "others:/srv/others"]}
    cases = {
        "tls://scheduler:8786,/srv/certs": "connected 3",
        "tls://scheduler:8786,/srv/others": "refused: .* cannot be reached",
        "tls://scheduler:8786,": "refused: .* speaks TLS and no certificates are given",
        "tcp://scheduler:8786,": "refused: .* cannot be reached",
    }
    code, found = deployment.finish("client", [sys.executable, "-c", CONNECT, *cases], part, STRANGER)
    assert code == 0, found
    for said, line in zip(cases.values(), re.findall("^(?:refused|connected).*$", found, re.MULTILINE), strict=True):
        assert re.match(said, line), found


@pytest.mark.parametrize("certificates", ["others", None])
def test_worker_is_refused_without_the_certificate(deployment, parts, certificates):
    make_certificates(deployment.folder / "volumes" / "others")
    command = [part.replace("--death-timeout=60", "--death-timeout=2") for part in parts["worker"]["command"]]
    if certificates is None:
        command = [part.replace("tls://", "tcp://") for part in command if "--tls" not in part]
    volumes = ["others:/srv/certs", "data:/srv/data"]
    part = {"volumes": volumes, "environment": {} if certificates is None else parts["worker"]["environment"]}
    code, said = deployment.finish("intruder", command, part, STRANGER)
    assert code != 0 or "Registered to" not in said, said
    assert "Registered to" not in said
    health = json.loads(deployment.wait_until_healthy("service"))
    assert health["workers"] == 1


def test_kubernetes_runs_the_commands_of_the_compose_file(parts):
    documents = list(yaml.safe_load_all((ROOT / "deploy" / "kubernetes.yaml").read_text(encoding="utf-8")))
    (cluster,) = (item["spec"] for item in documents if item["kind"] == "DaskCluster")
    (deployment,) = (item["spec"]["template"]["spec"] for item in documents if item["kind"] == "Deployment")
    found = {"scheduler": cluster["scheduler"]["spec"], "worker": cluster["worker"]["spec"], "service": deployment}
    for name, pod in found.items():
        (container,) = pod["containers"]
        own = {"--allowed-host", "--memory-limit", "--name"}
        arguments = [part.replace("tract-scheduler", "scheduler") for part in container["args"]]
        assert [part for part in arguments if part.split("=")[0] not in own] == [
            part for part in parts[name]["command"] if part.split("=")[0] not in own
        ]
        environment = {item["name"]: item["value"] for item in container["env"]}
        assert parts[name].get("environment", {}).items() <= environment.items()
        assert pod["securityContext"]["runAsNonRoot"]
        volumes = {volume["name"] for volume in pod["volumes"]}
        assert volumes == {mount["name"] for mount in container["volumeMounts"]}
    limit = found["worker"]["containers"][0]["resources"]["limits"]["memory"]
    assert f"--memory-limit={limit}" in found["worker"]["containers"][0]["args"]
