"""The process pool: results and errors come back; what dies, hangs or grows old is replaced."""

import asyncio
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from tract_dask.errors import SettingsError
from tract_dask.service.crashes import CrashError, ExhaustedError
from tract_dask.service.process_pool import ProcessPool, ProcessPoolError, ResultCache


def asked(pool: ProcessPool, function, *args, **limits):
    return asyncio.run(pool.run(function, *args, **limits))


def refuse(value: float) -> None:
    raise SettingsError("out of range", "the test", "below 1", f"{value}", "Try less")


def die_until(file: str) -> str:
    """End the process once; the second time there is the file."""
    if not Path(file).exists():
        Path(file).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "done"


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture(scope="module")
def pool():
    made = ProcessPool(1, places=1, imported=())
    yield made
    made.close()


def test_results_and_errors_come_back_by_value(pool):
    assert asked(pool, divmod, 17, 5) == (3, 2)
    with pytest.raises(SettingsError, match=r"the test: out of range. Expected below 1; got 3. Try less."):
        asked(pool, refuse, 3)
    with pytest.raises(RuntimeError, match="math domain error"):
        asked(pool, math.sqrt, -1.0)


def test_a_task_whose_process_dies_is_done_once_more(pool, tmp_path):
    assert asked(pool, die_until, str(tmp_path / "been here")) == "done"
    with pytest.raises(ProcessPoolError, match="die: the process that did this died"):
        asked(pool, die)
    assert asked(pool, math.sqrt, 9.0) == 3


def test_a_task_that_takes_too_long_is_ended(pool):
    first = asked(pool, os.getpid)
    began = time.monotonic()
    with pytest.raises(ProcessPoolError, match=r"sleep: this takes too long. Expected at most 0.2 s"):
        asked(pool, time.sleep, 30, timeout_s=0.2)
    assert time.monotonic() - began < 10
    assert asked(pool, os.getpid) != first
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)


def test_a_worker_is_replaced_after_so_many_tasks():
    pool = ProcessPool(1, tasks=4, imported=())
    try:
        first = {asked(pool, os.getpid) for _ in range(4)}
        assert len(first) == 1
        deadline = time.monotonic() + 30
        while asked(pool, os.getpid) in first:  # it goes on until its successor is ready
            assert time.monotonic() < deadline
            time.sleep(0.05)
    finally:
        pool.close()


def test_long_tasks_have_a_process_each(pool):
    pids = [asyncio.run(pool.run_long(os.getpid)) for _ in range(2)]
    assert len({*pids, os.getpid(), asked(pool, os.getpid)}) == 4


SERVICE = """
import asyncio, os, time
from tract_dask.service.process_pool import ProcessPool
pool = ProcessPool(1, imported=())
print(asyncio.run(pool.run(os.getpid)), flush=True)
asyncio.run(pool.run(time.sleep, 600))
"""


def test_a_worker_ends_with_a_killed_service_whatever_it_is_at():
    with subprocess.Popen([sys.executable, "-c", SERVICE], stdout=subprocess.PIPE, text=True) as service:
        worker = psutil.Process(int(service.stdout.readline()))
        time.sleep(0.2)  # it is given its task
        service.kill()
    worker.wait(10)


def test_what_does_not_fit_is_refused(pool):
    async def crowd():
        tasks = [asyncio.create_task(pool.run(time.sleep, 0.2)) for _ in range(3)]
        return await asyncio.gather(*tasks, return_exceptions=True)

    *done, refused = asyncio.run(crowd())
    assert done == [None, None]
    assert isinstance(refused, ProcessPoolError)
    assert refused.what == "the service has too much to do"
    assert asked(pool, math.sqrt, 4.0) == 2  # places are free again


def count_calls(file: str) -> bytes:
    with Path(file).open("a") as calls:
        calls.write("x")
    return Path(file).read_bytes()


def test_the_same_question_is_answered_once(pool, tmp_path):
    file = str(tmp_path / "calls")

    async def several():
        return await asyncio.gather(*(pool.run_cached("same", count_calls, file) for _ in range(5)))

    assert asyncio.run(several()) == [b"x"] * 5
    assert asyncio.run(pool.run_cached("same", count_calls, file)) == b"x"
    assert asyncio.run(pool.run_cached("another", count_calls, file)) == b"xx"


def test_an_error_is_not_kept(pool):
    for _ in range(2):
        with pytest.raises(SettingsError):
            asyncio.run(pool.run_cached("wrong", refuse, 1.0))


def test_a_cache_holds_what_was_asked_for_last():
    cache = ResultCache(80)
    for name in "abcdefgh":
        cache.put(name, b"0123456789")
    assert cache.get("a")  # asked for, so kept
    cache.put("i", b"0123456789")
    assert cache.get("b") is None
    assert [name for name in "acdefghi" if cache.get(name)] == list("acdefghi")
    cache.put("large", bytes(11))
    assert cache.get("large") is None


# --- files that kill or starve a reader -----------------------------------------------------------------------------


def crash(file: str, sign: int) -> None:
    with Path(file).open("a") as calls:
        calls.write("x")
    os.kill(os.getpid(), sign)


def crash_once(file: str) -> int:
    """Crash in a process that has done something before: one that was spoilt by it."""
    if not Path(file).read_text():
        crash(file, signal.SIGSEGV)
    return os.getpid()


def fill(size: int) -> int:
    return len(np.ones(size, np.uint8))


def sum_mapped(file: str) -> int:
    return int(np.load(file, mmap_mode="r")[:: 1 << 20].sum())


@pytest.mark.parametrize("sign", ["SIGSEGV", "SIGBUS", "SIGABRT", "SIGILL"])
def test_a_file_that_crashes_its_reader_is_named_and_not_opened_again_at_once(pool, tmp_path, sign):
    file = tmp_path / "bad.h5"
    file.touch()
    for _ in range(3):
        with pytest.raises(CrashError, match=rf"bad.h5: the reader crashed on this file.*got {sign}.*write it again"):
            asked(pool, crash, str(file), signal.Signals[sign], about=file)
    assert file.read_text() == "xx"  # once, and once more in a new process
    assert asked(pool, math.sqrt, 9.0) == 3


def test_a_file_that_was_written_again_is_opened(pool, tmp_path):
    file = tmp_path / "bad.h5"
    file.touch()
    with pytest.raises(CrashError):
        asked(pool, crash, str(file), signal.SIGSEGV, about=f"{file}::/inside")
    file.write_bytes(b"mended")
    assert asked(pool, math.sqrt, 9.0, about=f"{file}::/inside") == 3


def test_a_file_is_not_blamed_for_what_the_process_did_before(pool, tmp_path):
    file = tmp_path / "good.h5"
    file.touch()
    first = asked(pool, os.getpid)
    assert asked(pool, crash_once, str(file), about=file) != first
    assert asked(pool, math.sqrt, 9.0, about=file) == 3


def test_a_killed_process_is_not_the_file_s_fault(pool, tmp_path):
    with pytest.raises(ProcessPoolError, match="the process that did this died"):
        asked(pool, die, about=tmp_path)


def test_a_reader_that_does_not_come_to_an_end_is_ended_and_its_file_named(pool, tmp_path):
    file = tmp_path / "endless.tif"
    file.touch()
    with pytest.raises(CrashError, match=r"endless.tif: the reader did not finish with this file in time"):
        asked(pool, time.sleep, 60, timeout_s=0.2, about=file)
    began = time.monotonic()
    with pytest.raises(CrashError):
        asked(pool, time.sleep, 60, about=file)
    assert time.monotonic() - began < 10


def test_others_get_their_answers_while_a_file_crashes_readers(tmp_path):
    pool = ProcessPool(2, imported=())

    async def together():
        bad = [pool.run(crash, str(tmp_path / f"{k}.h5"), signal.SIGSEGV, about=f"{k}.h5") for k in range(3)]
        good = [pool.run(math.sqrt, float(k * k), about=f"{k}.tif") for k in range(10)]
        return await asyncio.gather(*bad, *good, return_exceptions=True)

    try:
        found = asyncio.run(together())
    finally:
        pool.close()
    assert [type(error) for error in found[:3]] == [CrashError] * 3
    assert [error.where for error in found[:3]] == ["0.h5", "1.h5", "2.h5"]
    assert found[3:] == list(range(10))


def test_memory_of_a_task_is_limited_and_mapped_files_do_not_count(tmp_path):
    size = 1 << 30
    mapped = np.lib.format.open_memmap(tmp_path / "large.npy", "w+", np.uint8, (size,))
    mapped[0] = 7
    mapped.flush()
    pool = ProcessPool(1, memory=512 << 20, imported=())
    try:
        assert asked(pool, sum_mapped, str(tmp_path / "large.npy")) == 7
        assert asked(pool, fill, 400 << 20) == 400 << 20
        first = asked(pool, os.getpid)
        with pytest.raises(ExhaustedError, match=r"x.tif: this needs more memory .* at most 537 MB"):
            asked(pool, fill, size, about="x.tif")
        assert asked(pool, os.getpid) != first
        assert asked(pool, sum_mapped, str(tmp_path / "large.npy")) == 7
    finally:
        pool.close()
