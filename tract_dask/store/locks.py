"""A folder, or a service's state, for one process alone, also where the file system knows no locks.

The kernel's lock (flock) ends with its process, however that ends. Some file systems have none (Lustre without its
option, some of FUSE), some lose it for a while, and some have one for each machine. So a holder leaves a record beside
the lock file as well: which process it is, and a sign of life (the record's time) every :data:`BEAT_S` seconds. Who
cannot have the kernel's lock goes by the record alone. A record holds as long as

- its process lives, where that can be seen: on the same machine, in the same container;
- its signs of life come, where it cannot. A record that gave none for :data:`STALE_S` seconds is watched for three
  beats more, since the clocks of two machines may differ, and then taken over.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import signal
import sys
import threading
import uuid
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from io import FileIO
from pathlib import Path
from time import monotonic, sleep, time
from typing import TypeAlias

from ..errors import DestinationError
from .files import read_small
from .held import hold, is_held, machine

BEAT_S = 5.0
"""Time between two signs of life."""

STALE_S = 60.0
"""A holder on another machine that gives no sign of life for so long has died."""

_LOOK_S = 0.1
_SETTLE_S = 0.2
_END_S = 5.0
_RECORD_BYTES = 4096
_OPEN = os.O_RDWR | os.O_CREAT | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0)
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL)


@contextmanager
def sole_use(lock: Path, what: str, patience_s: float = 0.0) -> Iterator[None]:
    """Hold the file ``lock`` against other processes, on this machine and others; it ends with the process.

    Meanwhile nothing is written or deleted under its folder where another takes that one's place, see :mod:`.held`.

    Raises
    ------
    DestinationError
        Saying ``what`` another process does, where it holds the lock and still does after ``patience_s``; also where
        the lock cannot be made, its folder was replaced, or another machine took it over because this process had
        stood still for too long.
    FileNotFoundError
        Where its folder is not there.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(hold(lock.parent))
            file = stack.enter_context(FileIO(os.open(lock, _OPEN, 0o666), "r+"))
        except FileNotFoundError:
            raise
        except OSError as error:
            raise _no_lock(lock, error) from error
        record = _wait(file, lock, what, patience_s)
        beating = _Beat(_beside(lock), record)
        try:
            yield
        except KeyboardInterrupt:
            if beating.lost:
                raise _taken_over(lock) from None
            raise
        finally:
            beating.end()


def _wait(file: FileIO, lock: Path, what: str, patience_s: float) -> _Record:
    """Take the lock, now or within ``patience_s``; return what stands in its record."""
    deadline, watches = monotonic() + patience_s, defaultdict[Path, _Watch](_Watch)
    while True:
        kernel = _flock(file, lock)
        if kernel is not False and (record := _take(_beside(lock), bool(kernel), watches)):
            return record
        if monotonic() >= deadline and not any(watch.may_end_soon for watch in watches.values()):
            raise _held(lock, what)
        _unlock(file, kernel)
        sleep(_LOOK_S)


def _flock(file: FileIO, lock: Path) -> bool | None:
    """Try to take the kernel's lock; False where another process has it, None where there are no locks."""
    if sys.platform == "win32":
        return None
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return None
        raise _no_lock(lock, error) from error
    return True


def _unlock(file: FileIO, kernel: bool | None) -> None:
    """Give the kernel's lock back while a record is in the way, so that nobody waits for this process instead."""
    if kernel and sys.platform != "win32":
        import fcntl

        fcntl.flock(file, fcntl.LOCK_UN)


_held_here: set[str] = set()
"""Tokens of the locks that this process holds, or tries to."""


@dataclass(frozen=True)
class _Record:
    """Who holds a lock.

    Attributes
    ----------
    token
        Another for every time that a lock is taken.
    place
        Where ``pid`` means this process: the running system, and the container.
    started
        When the process began, as the system counts; "" where that is not known.
    """

    token: str
    host: str
    place: str
    pid: int
    started: str

    @property
    def is_dead(self) -> bool | None:
        """Whether its process has ended; None where that cannot be seen."""
        if self.place != machine():
            return None
        if self.pid == os.getpid() and self.started == _started(self.pid):
            return self.token not in _held_here  # a folder that was moved meanwhile keeps its record
        return not _runs(self.pid) or _started(self.pid) not in ("", self.started)


class _Watch:
    """Looks at a record from another machine until it is clear that no sign of life comes."""

    def __init__(self) -> None:
        self._seen: tuple[str, float] | None = None
        self._since, self._beats = 0.0, 0
        self.may_end_soon = False

    def is_stale(self, token: str, beside: Path) -> bool:
        """Tell whether the record gave no sign of life for long enough."""
        with suppress(OSError):
            beat = beside.stat().st_mtime
            if self._seen != (token, beat):
                self._seen, self._since, self._beats = (token, beat), monotonic(), self._beats + 1
            self.may_end_soon = time() - beat > STALE_S and self._beats == 1  # one that beats lives, whatever its clock
            return self.may_end_soon and monotonic() - self._since > 3 * BEAT_S
        return False


_Watches: TypeAlias = defaultdict[Path, _Watch]


def _take(beside: Path, kernel: bool, watches: _Watches) -> _Record | None:
    """Leave a record if there is none that holds; None where there is."""
    own = _Record(uuid.uuid4().hex, platform.node(), machine(), os.getpid(), _started(os.getpid()))
    _held_here.add(own.token)
    try:
        if _write_new(beside, own):
            return own
        if not _holds(beside, watches[beside]) and _take_over(beside, own, watches):
            return own
        _held_here.discard(own.token)
        return None
    except OSError as error:
        if kernel:  # a full disk, say; the kernel's lock is enough
            return own
        raise _no_lock(beside, error) from error


def _holds(beside: Path, watch: _Watch) -> bool:
    found = _read(beside)
    if found is None:  # it is being written, or was by a process that died of it
        return beside.exists() and not watch.is_stale("", beside)
    return not (watch.is_stale(found.token, beside) if found.is_dead is None else found.is_dead)


def _take_over(beside: Path, own: _Record, watches: _Watches) -> bool:
    """Put a record in the place of one that holds no more; of several processes that try, one succeeds."""
    guard = _guard(beside)
    if not _write_new(guard, own):
        if not _holds(guard, watches[guard]):
            guard.unlink(missing_ok=True)  # its maker has died; one of those who try now makes another
        return False
    try:
        if _holds(beside, watches[beside]):
            return False
        beside.unlink(missing_ok=True)
        if not _write_new(beside, own):
            return False
        sleep(_SETTLE_S)  # one that had found the old record, too, would put its own here now
        found = _read(beside)
        return found is not None and found.token == own.token
    finally:
        _remove(guard, own)


def _write_new(path: Path, record: _Record) -> bool:
    """Write a record where there is no file yet; tell whether that was so."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    except FileExistsError:
        return False
    try:
        os.write(descriptor, json.dumps(asdict(record)).encode())
    except OSError:
        path.unlink(missing_ok=True)
        raise
    finally:
        os.close(descriptor)
    return True


def _read(path: Path) -> _Record | None:
    try:
        return _Record(**json.loads(read_small(path, _RECORD_BYTES)))
    except (OSError, ValueError, TypeError, RecursionError):
        return None


def _remove(path: Path, own: _Record) -> None:
    with suppress(OSError):
        found = _read(path)
        if found is not None and found.token == own.token:
            path.unlink()


class _Beat:
    """Gives the signs of life of a record, and removes it at the end.

    Where another process has taken the record over, the main thread is interrupted.
    """

    def __init__(self, beside: Path, record: _Record) -> None:
        self._beside, self._record = beside, record
        self._ending, self.lost = threading.Event(), False
        self._thread = threading.Thread(target=self._go, name="lock", daemon=True)
        self._thread.start()

    def _go(self) -> None:
        while not self._ending.wait(BEAT_S):
            found = _read(self._beside)
            with suppress(OSError):  # the next one may go well
                if not is_held(self._beside):
                    continue  # another folder lies there: what the run writes next says so
                if found is not None and found.token != self._record.token:
                    self.lost = True
                    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
                    return
                if found is not None or not _write_new(self._beside, self._record):
                    os.utime(self._beside)

    def end(self) -> None:
        self._ending.set()
        self._thread.join(_END_S)  # it may wait for a dead disk
        with suppress(OSError):
            if is_held(self._beside):
                _remove(self._beside, self._record)
        _held_here.discard(self._record.token)


def lock_files(lock: Path) -> tuple[Path, ...]:
    """Return the files of a lock, for who deletes the folder that it holds."""
    return lock, _beside(lock), _guard(_beside(lock))


def _guard(beside: Path) -> Path:
    return beside.with_name(f"{beside.name}.guard")


def _beside(lock: Path) -> Path:
    return lock.with_name(f"{lock.name}.holder")


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _started(pid: int) -> str:
    """Return when a process began, as /proc counts it, or that it has ended; "" where that is not known."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        state, *_, started = text.rpartition(")")[2].split()[:20]
    except (OSError, ValueError):
        return ""
    return "ended" if state in ("Z", "X") else started


def _held(lock: Path, what: str) -> DestinationError:
    holder = _read(_beside(lock))
    is_far = holder is not None and holder.is_dead is None
    return DestinationError(
        what,
        str(lock.parent),
        got=f"process {holder.pid} on {holder.host}" if holder else "",
        remedy="Wait for it, stop it, or choose another place"
        + (f"; one that was killed there counts as ended after {STALE_S:g} s" if is_far else ""),
    )


def _no_lock(lock: Path, error: OSError) -> DestinationError:
    return DestinationError(
        "this folder cannot be locked",
        str(lock.parent),
        "a folder that you may write to",
        error.strerror or str(error),
        "Correct its permissions or free some space, or choose another place",
    )


def _taken_over(lock: Path) -> DestinationError:
    return DestinationError(
        "another machine took this folder over",
        str(lock.parent),
        f"a sign of life of this process every {STALE_S:g} s",
        "none for longer",
        "Wait until the other run has ended, and run again: what is done is kept",
    )
