"""The peers' own environment: a venv beside this file, into which each peer is installed when it is first needed."""

from __future__ import annotations

import json
import subprocess
import sys
import venv
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).parent
VENV = HERE / ".venv"
REQUIREMENTS = HERE / "peers" / "requirements.txt"

PACKAGES = {
    "picasso": ("picassosr",),
    "scipy": ("scipy",),
    "lmfit": ("lmfit",),
    "atomap": ("atomap", "hyperspy"),
    "trackpy": ("trackpy",),
}
"""What to install for each peer."""


def peers_python(peers: Sequence[str]) -> Path:
    """Return the Python of the peers' environment, with these peers installed in it."""
    folder = VENV / ("Scripts" if sys.platform == "win32" else "bin")
    wanted = [package for peer in peers for package in PACKAGES[peer]]
    python = folder / "python"
    if not folder.exists():
        venv.create(VENV, with_pip=True)
    missing = sorted(set(wanted) - set(versions(python)))
    if missing:
        print(f"Installing {', '.join(missing)} into {VENV} ...", file=sys.stderr)
        packages = ["--quiet", "--constraint", str(REQUIREMENTS), *missing]
        uv = [sys.executable, "-m", "uv", "pip", "install", "--python", str(python), *packages]
        if find_spec("uv") is None or subprocess.run(uv, check=False, stdout=sys.stderr).returncode:
            subprocess.run([python, "-m", "pip", "install", *packages], check=True, stdout=sys.stderr)
    return python


def versions(python: Path) -> dict[str, str]:
    """Return the versions of the peers' packages that this Python has, and of numpy and numba."""
    listed = subprocess.run(
        [python, "-m", "pip", "list", "--format=json", "--disable-pip-version-check"],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    known = {package for packages in PACKAGES.values() for package in packages} | {"numpy", "numba"}
    return {item["name"]: item["version"] for item in json.loads(listed.stdout) if item["name"] in known}
