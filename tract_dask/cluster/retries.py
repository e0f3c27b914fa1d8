"""What is tried again: errors of a machine that may pass, and how often and where a shard or a stage is tried."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from time import sleep
from typing import TypeVar

import dask
from distributed.comm import CommClosedError
from distributed.worker import get_worker

from ..errors import ClusterError, StoreError, TractError
from ..progress import Sink, Warned

RETRY = "tract_dask.retry-s"
"""Item of Dask's configuration: the wait before the second try, in s; each next one is twice as long."""

Done = TypeVar("Done")

MOST_TRIES = 6
"""So often a shard is tried, at least, before an error that may pass ends the work; so often a stage is."""

ROW = 3
"""A worker with so many failures in a row, while others succeed, is left out; also: so many hosts have to fail."""

_RETRY_S, _LONGEST_WAIT = 1.0, 16


def _numbers(names: str) -> frozenset[int]:
    return frozenset(getattr(errno, name) for name in names.split() if hasattr(errno, name))


PASSING = _numbers(
    "EAGAIN EBUSY ECOMM ECONNABORTED ECONNREFUSED ECONNRESET EDEADLK EHOSTDOWN EHOSTUNREACH EINTR EIO EMFILE ENETDOWN"
    " ENETRESET ENETUNREACH ENFILE ENOBUFS ENODEV ENOLCK ENOLINK ENOMEM ENONET ENOTCONN ENXIO EPIPE EPROTO EREMOTE"
    " EREMOTEIO ESHUTDOWN ESTALE ETIME ETIMEDOUT"
)
"""Errors of the system that come and go: of networks, of disks, and of what is scarce for a while."""

ELSEWHERE = _numbers("EACCES ELOOP ENOENT ENOTDIR EPERM")
"""Errors of the system that another machine may not have: here a mount is missing, say."""

_IN_TEXT = re.compile(r"\berrno = (\d+)")
"""How HDF5 says it."""


@dataclass(frozen=True)
class Place:
    """A worker, and the host that it runs on; empty for this process."""

    worker: str = ""
    host: str = ""

    @classmethod
    def here(cls) -> Place:
        """Return the place of the task that calls this."""
        address = str(get_worker().address)
        return cls(address, host_of(address))


@dataclass(frozen=True)
class Trouble:
    """An error that a shard met, and that it may not meet again.

    Attributes
    ----------
    number
        Of the system's error.
    where
        The file, as far as it is known.
    error
        What to raise where it does not pass.
    """

    number: int
    where: str
    place: Place
    error: TractError

    @property
    def passes(self) -> bool:
        """Whether it may pass on the same machine."""
        return self.number in PASSING

    def __str__(self) -> str:
        return f"{self.where}: {os.strerror(self.number)} ({errno.errorcode[self.number]})"


def host_of(address: str) -> str:
    """Return the host in the address of a worker.

    Examples
    --------
    >>> host_of("tls://10.0.0.2:33445"), host_of("tcp://[::1]:80")
    ('10.0.0.2', '[::1]')
    """
    rest = address.partition("://")[2]
    return rest.rpartition(":")[0] or rest.partition("/")[0]


def trouble(error: BaseException, place: Place, file: str) -> Trouble | None:
    """Return the trouble that an error means; None where a further try would end in the same way.

    Parameters
    ----------
    file
        To be named where the error names none.
    """
    for cause in _chain(error):
        number = _number(cause) if isinstance(cause, OSError) else None
        if number in PASSING or number in ELSEWHERE:
            assert number is not None
            where = _where(error, cause, file)
            return Trouble(number, where, place, _explained(error, number, where, place))
    return None


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error, and those that it came of."""
    while error is not None:
        yield error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def _number(error: OSError) -> int | None:
    if error.errno is not None:
        return error.errno
    said = _IN_TEXT.search(str(error))
    return int(said.group(1)) if said else None


def _where(error: BaseException, cause: BaseException, file: str) -> str:
    return str(getattr(cause, "filename", None) or "") or (error.where if isinstance(error, TractError) else "") or file


def _explained(error: BaseException, number: int, where: str, place: Place) -> TractError:
    """Return what is raised: the error, if it is one of ours; otherwise one that says the same."""
    on = f"on worker {place.worker}" if place.worker else ""
    if isinstance(error, TractError):
        got = ", ".join(filter(None, (error.got, on)))
        return type(error)(error.what, error.where, error.expected, got, error.remedy)
    return StoreError(
        "a file cannot be read or written",
        where,
        got=", ".join(filter(None, (os.strerror(number), on))),
        remedy="Check the file system of that machine, then run the same command again: what is done is kept",
    )


def wait_s(tries: int) -> float:
    """Return how long (s) to wait after so many tries.

    Examples
    --------
    >>> [wait_s(tries) for tries in (1, 2, 3, 9)]
    [1.0, 2.0, 4.0, 16.0]
    """
    first = float(dask.config.get(RETRY, _RETRY_S))
    return first * float(min(2 ** (tries - 1), _LONGEST_WAIT))


def persist(
    work: Callable[[], Done], send: Sink, file: str, is_final: Callable[[Exception], bool] = lambda error: False
) -> Done:
    """Do what can be done again, once more wherever this process meets an error that may pass; return what it returns.

    What tasks meet is tried again shard by shard, and comes here as an error that is final.

    Parameters
    ----------
    send
        Takes a warning before each wait.
    file
        To be named where an error names none.
    is_final
        Tells errors that end the work though they look as if they could pass.

    Raises
    ------
    TractError
        Where an error has not passed in :data:`MOST_TRIES` tries. Others are raised as they are.
    """
    tries = 1
    while True:
        try:
            return work()
        except (ClusterError, CommClosedError):
            raise
        except Exception as error:
            met = None if is_final(error) else trouble(error, Place(), file)
            if met is None or not met.passes or met.number == errno.EAGAIN:  # somebody else's lock
                raise
            if tries == MOST_TRIES:
                raise met.error from error
        send(Warned(f"{met}; it is tried again in {wait_s(tries):g} s"))
        sleep(wait_s(tries))
        tries += 1


def is_hopeless(troubles: Sequence[Trouble], workers: Collection[str]) -> bool:
    """Tell whether a shard with these troubles is given up: each worker has failed, or three hosts, and often enough.

    What may pass is tried :data:`MOST_TRIES` times; what does not pass on one machine, once on each.
    """
    places, last = {met.place for met in troubles}, troubles[-1]
    hosts = {place.host for place in places}
    if not last.passes:
        return len(hosts) >= ROW or {host_of(worker) for worker in workers} <= hosts
    everywhere = set(workers) <= {place.worker for place in places}
    return len(troubles) >= MOST_TRIES and (everywhere or len(hosts) >= ROW)


def places_to_avoid(troubles: Sequence[Trouble], workers: Collection[str]) -> set[str]:
    """Return the workers that a shard with these troubles is not given to: whole hosts, where there are others."""
    hosts = {met.place.host for met in troubles}
    on_them = {worker for worker in workers if host_of(worker) in hosts}
    return on_them if set(workers) - on_them else {met.place.worker for met in troubles}


class Rows:
    """How many failures in a row each worker has had, while others succeeded."""

    def __init__(self) -> None:
        self._rows: dict[str, tuple[int, int]] = {}
        self._successes = 0

    def succeeded(self, worker: str) -> None:
        """Note that a worker has finished something."""
        self._rows.pop(worker, None)
        self._successes += 1

    def failed(self, worker: str) -> bool:
        """Note a failure; tell whether the worker is to be left out."""
        count, since = self._rows.get(worker, (0, self._successes))
        self._rows[worker] = count + 1, since
        return count + 1 >= ROW and self._successes > since
