"""Hosts on one machine, for tests: network namespaces with addresses and names, joined by a bridge of their own.

Nothing of it touches the machine's network: the bridge is in a namespace too. Each process also has its own view of the
file system, in which folders can be put at other places (as volumes are in containers).
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SUBNET = "10.213.77"


@dataclass(frozen=True)
class Host:
    """One of the hosts; ``hosts_file`` names all of them."""

    name: str
    namespace: str
    address: str
    hosts_file: Path

    def popen(
        self, command: Sequence[str], volumes: Mapping[Path, str], environment: Mapping[str, str], **options: Any
    ) -> subprocess.Popen[str]:
        """Start a command here; ``volumes`` are folders, and where under /srv the command finds them."""
        binds = [f"mount --bind {self.hosts_file} /etc/hosts", "mount -t tmpfs none /srv"]
        for folder, place in volumes.items():
            assert place.startswith("/srv/"), f"{place} is no place under /srv, which every Debian has"
            binds.append(f"mkdir -p {place} && mount --bind {folder} {place}")
        script = " && ".join([*binds, 'exec "$@"'])
        inside = ["ip", "netns", "exec", self.namespace, "sh", "-euc", script, "sh", *command]
        return subprocess.Popen(inside, env=dict(environment), text=True, start_new_session=True, **options)


@contextmanager
def network(names: Sequence[str], folder: Path) -> Iterator[dict[str, Host]]:
    """Yield hosts that reach each other by these names; they go with the block, and their processes with them."""
    prefix = f"td{os.getpid()}"
    assert shutil.which("ip"), "ip is missing (on Debian: apt-get install iproute2)"
    made = subprocess.run(["ip", "netns", "add", prefix], capture_output=True, text=True, check=False)
    assert made.returncode == 0, f"network namespaces are needed here, and not permitted: {made.stderr.strip()}"
    hosts_file = folder / "hosts"
    addresses = {name: f"{SUBNET}.{k}" for k, name in enumerate(names, 10)}
    hosts_file.write_text("127.0.0.1 localhost\n" + "".join(f"{ip} {name}\n" for name, ip in addresses.items()))
    hosts = {name: Host(name, f"{prefix}-{name}", ip, hosts_file) for name, ip in addresses.items()}
    try:
        _ip(f"-n {prefix} link add bridge type bridge", f"-n {prefix} link set bridge up")
        for k, host in enumerate(hosts.values()):
            inner = f"-n {host.namespace}"
            _ip(
                f"netns add {host.namespace}",
                f"{inner} link set lo up",
                f"link add eth0 netns {host.namespace} type veth peer name port{k} netns {prefix}",
                f"{inner} address add {host.address}/24 dev eth0",
                f"{inner} link set eth0 up",
                f"-n {prefix} link set port{k} master bridge up",
            )
        yield hosts
    finally:
        for namespace in (*(host.namespace for host in hosts.values()), prefix):
            found = subprocess.run(["ip", "netns", "pids", namespace], capture_output=True, text=True, check=False)
            for pid in found.stdout.split():
                os.kill(int(pid), signal.SIGKILL)
            subprocess.run(["ip", "netns", "del", namespace], capture_output=True, check=False)


def _ip(*commands: str) -> None:
    for command in commands:
        done = subprocess.run(["ip", *command.split()], capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"ip {command}: {done.stderr.strip()}"
