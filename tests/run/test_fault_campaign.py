"""The campaign of faults: what it takes for what, and a short one."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path
from random import Random
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[2]
PROBE = """
import os, sys
file = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT)
for _ in range(4):
    try:
        os.pwrite(file, b"x", 0)
        print("written")
    except OSError as error:
        print(error.strerror)
"""


campaign = SimpleNamespace(**runpy.run_path(str(ROOT / "scripts" / "fault_campaign")))


@pytest.mark.parametrize(
    ("code", "text", "fault"),
    [
        (0, "", ""),
        (1, "Error: /x/movie.zarr: damaged. Remove it.", ""),
        (1, "Error: unexpected KeyError: 'a'. Add --debug to see where", "TRACEBACK"),
        (1, "Traceback (most recent call last):\n...", "TRACEBACK"),
        (None, "", "HANG"),
    ],
)
def test_how_a_run_ended_is_told_by_its_code_and_words(code, text, fault):
    assert campaign.Ended(code, text).fault == fault


def test_the_advice_of_an_error_is_followed(tmp_path):
    output = tmp_path / "out"
    for name in ("movie.zarr", "results.zarr", "columns.zarr", "sum.zarr"):
        (output / name).mkdir(parents=True)
    (output / "columns.csv").touch()
    assert campaign.follow(f"Error: {output}/movie.zarr/0/c.1: a bit. Remove the store.", output) == ()
    assert campaign.follow(f"a bit. Remove {output}/results.zarr and run the command again.", output) == ()
    advice = f"Remove {output}/columns.zarr, move columns.csv beside it elsewhere, and run it again."
    assert campaign.follow(advice, output) == ()
    assert [path.name for path in output.iterdir()] == ["sum.zarr"]
    assert campaign.follow("the disk is full: make room", output) == ()
    assert campaign.follow("Remove /etc/passwd", output) == ()
    assert campaign.follow("use --overwrite to discard it", output) == ("--overwrite",)
    assert (output / "sum.zarr").exists()


def test_other_numbers_without_a_word_are_the_worst(tmp_path):
    case = campaign.Case("flipped bit", "fit", tmp_path, Random(0))
    assert campaign.judge(case, []) == "identical"
    case.said.append("Error: damaged")
    assert campaign.judge(case, []) == "clear error"
    assert campaign.judge(case, ["results.zarr/fit"]) == "SILENTLY DIFFERENT"


def test_harms_change_what_they_say(tmp_path):
    file, case = tmp_path / "c.0", campaign.Case("flipped bit", "fit", tmp_path, Random(0))
    for _ in range(20):
        file.write_bytes(bytes(5000))
        campaign.flip(case, file)
        assert sum(byte.bit_count() for byte in file.read_bytes()) == 1
    file.write_bytes(b'[1, {"a": 1}]\n' * 9)
    before = file.read_bytes()
    assert campaign.garble(case, file)
    assert file.read_bytes() != before


@pytest.mark.parametrize(("once", "said"), [(True, ["written"] * 3), (False, ["written", *["Input/output error"] * 2])])
def test_the_shim_lets_writes_of_one_file_fail(tmp_path, once, said):
    shim = campaign.compiled_shim(tmp_path)
    assert shim, "this test needs a C compiler"
    environment = os.environ | {
        "LD_PRELOAD": str(shim),
        "FAULT_MATCH": "harmed",
        "FAULT_OP": "w",
        "FAULT_ERRNO": "5",
        "FAULT_AFTER": "1",
    }
    if once:
        environment["FAULT_MARK"] = str(tmp_path / "mark")
    for name, expected in (("sound", ["written"] * 4), ("harmed", sorted([*said, "Input/output error"]))):
        command = [sys.executable, "-c", PROBE, tmp_path / name]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert sorted(done.stdout.splitlines()) == sorted(expected)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_short_campaign_ends_with_the_same_numbers_or_a_clear_error(tmp_path):
    """A fault of three kinds; the whole campaign has all of them."""
    kinds = ["kill driver", "flipped bit", "write error"]
    command = [ROOT / "scripts/fault_campaign", "--faults", "3", "--folder", tmp_path, "--kinds", *kinds]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
