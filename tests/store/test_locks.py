"""A lock is held by one process at a time, with the kernel's locks and without, however its holder ends."""

import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest

from tract_dask.errors import DestinationError
from tract_dask.store import locks
from tract_dask.store.locks import sole_use

BUSY = "another run works here"


def without_locks(monkeypatch, code: int = errno.ENOSYS) -> None:
    def refuse(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", refuse)


def process(body: str, *arguments: object, kernel: bool = False) -> subprocess.Popen[str]:
    """Start a process that has ``sole_use``, BUSY and ``lock``; the kernel's locks work in it only with ``kernel``."""
    head = f"""
        import errno, fcntl, os, sys, time
        from pathlib import Path
        def refuse(*_): raise OSError(errno.ENOSYS, "no locks")
        if not {kernel}: fcntl.flock = refuse
        from tract_dask.errors import DestinationError
        from tract_dask.store.locks import sole_use
        lock, BUSY = Path(sys.argv[1]), {BUSY!r}
    """
    code = textwrap.dedent(head) + textwrap.dedent(body)
    return subprocess.Popen([sys.executable, "-c", code, *map(str, arguments)], stdout=subprocess.PIPE, text=True)


HOLD = """
    with sole_use(lock, BUSY):
        print("held", flush=True)
        time.sleep(60)
"""


@pytest.fixture
def lock(tmp_path) -> Path:
    return tmp_path / ".lock"


@pytest.fixture(params=[True, False], ids=["kernel", "no kernel"])
def held(request, lock):
    """A process that holds the lock."""
    holder = process(HOLD, lock, kernel=request.param)
    assert holder.stdout.readline() == "held\n"
    yield holder
    holder.kill()
    holder.communicate()


def take(lock: Path, patience_s: float = 0.0) -> None:
    with sole_use(lock, BUSY, patience_s):
        pass


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_no_obstacle(lock, monkeypatch, code):
    without_locks(monkeypatch, code)
    with sole_use(lock, BUSY), pytest.raises(DestinationError, match=rf"{BUSY}.*process {os.getpid()} on"):
        take(lock)
    take(lock)
    assert [file.name for file in lock.parent.iterdir()] == [".lock"]


@pytest.mark.parametrize("kernel", [True, False])
def test_one_that_lives_is_not_pushed_aside_and_one_that_was_killed_is(held, lock, monkeypatch, kernel):
    if not kernel:
        without_locks(monkeypatch)
    with pytest.raises(DestinationError, match=BUSY):
        take(lock)
    held.send_signal(signal.SIGSTOP)
    with pytest.raises(DestinationError, match=BUSY):
        take(lock, 0.3)
    held.kill()  # not waited for: it stays as a zombie
    take(lock, patience_s=10.0)


def test_a_number_that_another_process_has_now_is_no_holder(lock, monkeypatch):
    without_locks(monkeypatch)
    beside = lock.with_name(".lock.holder")
    record = {"token": "a", "host": "here", "place": locks.machine(), "pid": os.getpid(), "started": "1"}
    beside.write_text(json.dumps(record))
    take(lock)


CONTEND = """
    import random
    inside, done = Path(sys.argv[2]), 0
    while done < 12:
        with sole_use(lock, BUSY, 60.0):
            os.close(os.open(inside, os.O_CREAT | os.O_EXCL))
            time.sleep(0.002)
            os.unlink(inside)
            done += 1
            if random.random() < 0.05:
                os._exit(0)  # it leaves its record behind
        time.sleep(0.01 * random.random())
"""


def test_of_many_one_at_a_time_holds_it_also_where_holders_die(lock, tmp_path):
    crowd = [process(CONTEND, lock, tmp_path / "inside", kernel=k == 0) for k in range(5)]
    for one in crowd:
        one.communicate(timeout=100)
    assert [one.returncode for one in crowd] == [0] * 5


def foreign(lock: Path, age_s: float) -> Path:
    """Leave the record of a process on another machine."""
    beside = lock.with_name(".lock.holder")
    record = {"token": "far", "host": "node7", "place": "node7", "pid": 1, "started": "1"}
    beside.write_text(json.dumps(record))
    os.utime(beside, (time.time() - age_s,) * 2)
    return beside


@pytest.mark.parametrize("kernel", [True, False])
def test_another_machine_s_lock_holds_while_it_gives_signs_of_life(lock, monkeypatch, kernel):
    """Also where this one has the kernel's lock, which on some file systems is for one machine only."""
    if not kernel:
        without_locks(monkeypatch)
    foreign(lock, age_s=locks.STALE_S - 40)
    with pytest.raises(DestinationError, match="on node7"):
        take(lock)


def test_another_machine_s_lock_is_taken_over_once_it_gives_no_sign_of_life(lock, monkeypatch):
    without_locks(monkeypatch)
    monkeypatch.setattr(locks, "BEAT_S", 0.1)
    foreign(lock, age_s=locks.STALE_S + 60)
    began = time.monotonic()
    take(lock)  # it is watched for three beats, whatever the patience
    assert 0.3 < time.monotonic() - began < 10


def test_a_machine_whose_clock_is_wrong_keeps_its_lock(lock, monkeypatch):
    without_locks(monkeypatch)
    monkeypatch.setattr(locks, "BEAT_S", 0.4)
    beside = foreign(lock, age_s=3600)
    ending = threading.Event()

    def beat() -> None:
        while not ending.wait(0.2):
            os.utime(beside, (beside.stat().st_mtime + 0.2,) * 2)

    beating = threading.Thread(target=beat)
    beating.start()
    try:
        with pytest.raises(DestinationError, match="on node7"):
            take(lock, patience_s=2.0)
    finally:
        ending.set()
        beating.join()


def test_signs_of_life_are_given(lock, monkeypatch):
    monkeypatch.setattr(locks, "BEAT_S", 0.05)
    with sole_use(lock, BUSY):
        beside = lock.with_name(".lock.holder")
        os.utime(beside, (1, 1))
        deadline = time.monotonic() + 10
        while beside.stat().st_mtime < 2:
            assert time.monotonic() < deadline
            time.sleep(0.02)


def test_a_holder_whose_lock_was_taken_over_ends(lock, monkeypatch):
    without_locks(monkeypatch)
    monkeypatch.setattr(locks, "BEAT_S", 0.05)
    answer = signal.signal(signal.SIGINT, signal.default_int_handler)  # an imported package may have taken it

    def work() -> None:
        with sole_use(lock, BUSY):
            foreign(lock, age_s=0)
            time.sleep(60)

    try:
        with pytest.raises(DestinationError, match="another machine took this folder over"):
            work()
    finally:
        signal.signal(signal.SIGINT, answer)
    assert lock.with_name(".lock.holder").exists()  # the other's


def test_a_pipe_is_not_waited_for_and_a_link_not_followed(lock, tmp_path):
    os.mkfifo(lock)
    take(lock)
    lock.unlink()
    lock.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DestinationError, match="cannot be locked"):
        take(lock)
    assert not (tmp_path / "elsewhere").exists()


def test_a_folder_can_be_deleted_by_who_holds_it(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    with sole_use(folder / ".lock", BUSY):
        for file in locks.lock_files(folder / ".lock"):
            file.unlink(missing_ok=True)
        folder.rmdir()
    with pytest.raises(FileNotFoundError):
        take(folder / ".lock")


def test_a_disk_error_says_so(lock, monkeypatch):
    without_locks(monkeypatch, errno.EIO)
    with pytest.raises(DestinationError, match=r"cannot be locked.*error"):
        take(lock)


def test_a_folder_that_was_moved_while_it_was_held_can_be_held_again_by_the_same_process(tmp_path):
    lock, moved = tmp_path / "out" / ".lock", tmp_path / "moved"
    lock.parent.mkdir()
    with sole_use(lock, BUSY):
        lock.parent.rename(moved)
    with sole_use(moved / lock.name, BUSY), pytest.raises(DestinationError, match=BUSY):
        sole_use(moved / lock.name, BUSY).__enter__()
