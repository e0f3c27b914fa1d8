"""A SLURM of one node on this machine, for tests: munged, slurmctld and slurmd with folders and ports of their own."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

CONFIG = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller_port}
SlurmdPort={node_port}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket
CryptoType=crypto/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerParameters=sched_interval=1,bf_interval=1
SlurmdParameters=config_overrides
ReturnToService=2
KillWait=5
CompleteWait=0
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
NodeName={host} NodeAddr=127.0.0.1 CPUs=16 RealMemory=64000
PartitionName=test Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


@contextmanager
def slurm_daemons() -> Iterator[Path]:
    """Start SLURM and yield its configuration file, for the variable SLURM_CONF; everything ends with the block."""
    missing = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if shutil.which(name, path=_PATH) is None]
    assert not missing, f"these are missing: {', '.join(missing)} (on Debian: apt-get install slurm-wlm munge)"
    assert os.getuid() == 0, "slurmd needs to be root"
    host = socket.gethostname().split(".")[0]
    with tempfile.TemporaryDirectory(prefix="slurm-") as name, ExitStack() as stack:
        folder = Path(name)
        for child in ("munge", "state", "spool"):
            (folder / child).mkdir(mode=0o755 if child == "munge" else 0o700)
        folder.chmod(0o755)
        key = folder / "munge" / "key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        config = folder / "slurm.conf"
        ports = {"controller_port": _free_port(), "node_port": _free_port()}
        config.write_text(CONFIG.format(folder=folder, host=host, user="root", **ports))
        munge = [f"--{item}={folder}/munge/{item}" for item in ("socket", "pid-file", "log-file", "seed-file")]
        munge = ["munged", "--foreground", f"--key-file={key}", *munge, "--force"]
        for command in (munge, ["slurmctld", "-D", "-f", config], ["slurmd", "-D", "-f", config, "-N", host, "-c"]):
            with (folder / f"{command[0]}.out").open("w") as out:
                stack.enter_context(_process([str(part) for part in command], out))
        _wait_for_node(folder)
        try:
            yield config
        finally:
            subprocess.run(["scancel", "--user=root"], env=environment(config), check=False, timeout=20)
            _wait(lambda: not _ask(config, "squeue", "--noheader"), 20, folder)


def environment(config: Path) -> dict[str, str]:
    """Return the variables with which SLURM's commands find this SLURM."""
    return os.environ | {"SLURM_CONF": str(config)}


_PATH = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"


def _ask(config: Path, *command: str) -> str:
    done = subprocess.run(command, env=environment(config), capture_output=True, text=True, check=False, timeout=20)
    return done.stdout.strip() if done.returncode == 0 else f"failed: {done.stderr}"


def _wait_for_node(folder: Path) -> None:
    _wait(lambda: _ask(folder / "slurm.conf", "sinfo", "--noheader", "--format=%T") == "idle", 30, folder)


def _wait(true, seconds: float, folder: Path) -> None:
    deadline = time.monotonic() + seconds
    while not true():
        logs = "\n".join(f"{log}: {log.read_text()[-2000:]}" for log in folder.glob("*.log"))
        assert time.monotonic() < deadline, f"SLURM is not ready\n{logs}"
        time.sleep(0.1)


@contextmanager
def _process(command: list[str], out) -> Iterator[None]:
    process = subprocess.Popen(command, stdout=out, stderr=out, env=os.environ | {"PATH": _PATH})
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(15)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]
