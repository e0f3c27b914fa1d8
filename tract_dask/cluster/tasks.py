"""The loop that keeps workers busy with shards, and takes their results as they come."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from time import perf_counter, sleep

import numpy as np
from distributed import Client

from ..errors import StoreError
from ..progress import Sink, Warned, silent
from ..store.journal import Journal, Payload
from ..store.shards import Shard
from .batch import BATCH_S, Numbers, Work
from .dispatch import Dispatch, Finished, Tell
from .retries import Place, Trouble, host_of, is_hopeless, trouble, wait_s

_ROUNDS = 3
"""So often shards are made that are not on disk afterwards."""

_LOOK_AGAIN_S = (0.2, 1.0)
_FAR_LOOK_AGAIN_S = (5.0, 30.0, 60.0)
"""After such waits they are looked for again; after more of them where workers are on other machines, whose files a
network disk may show for so long as missing."""

_HERE = ("127.0.0.1", "[::1]", "localhost")


def _nothing(shard: Shard, payload: Payload) -> None:
    pass


def run_shards(
    task: Callable[[Shard], Payload],
    shards: Sequence[Shard],
    *,
    journal: Journal,
    name: str,
    client: Client | None = None,
    on_done: Callable[[Shard, Payload], None] = _nothing,
    file: str = "the files of this stage",
    on_event: Sink = silent,
) -> dict[int, Payload]:
    """Run ``task`` on every shard that the journal does not know, and return the payloads of all by index.

    Arguments and errors are those of :func:`stream_shards`, which keeps nothing.
    """
    payloads: dict[int, Payload] = {}

    def keep(shard: Shard, payload: Payload) -> None:
        payloads[shard.index] = payload

    stream_shards(
        task, shards, keep, journal=journal, name=name, client=client, on_done=on_done, file=file, on_event=on_event
    )
    return payloads


def stream_shards(
    task: Callable[[Shard], Payload],
    shards: Sequence[Shard],
    take: Callable[[Shard, Payload], None],
    *,
    journal: Journal,
    name: str,
    client: Client | None = None,
    on_done: Callable[[Shard, Payload], None] = _nothing,
    file: str = "the files of this stage",
    on_event: Sink = silent,
) -> None:
    """Run ``task`` on every shard that the journal does not know, and hand every payload to ``take``.

    On a cluster, shards that take little time go out several at once: a task takes them one by one, and notes each in
    the journal, for about half a second. In the end every shard is looked at on disk, and made again where it is not
    as the journal says; that is said.

    Parameters
    ----------
    task
        Takes a shard, writes its result, returns its payload. Pass paths to it, not data.
    shards
        From :func:`split`: each is sent to the workers by its place among them, which is its ``index``.
    take
        Called once for each shard: first for those in the journal, then for the others as they are done.
    name
        Stage name, shown on the dashboard.
    client
        The cluster to run on; None runs in this process.
    on_done
        Called with each shard that this call finished, as it comes.
    file
        What the shards are read from, to be named where an error names nothing.
    on_event
        Takes warnings: of errors that may pass, of workers that die or hang, and of shards that are not on disk.

    Raises
    ------
    TractError
        The first error of a task that does not pass (:mod:`tract_dask.cluster.retries`); finished shards stay in the
        journal.
    StoreError
        Where shards crash the workers that work on them, where a shard is not on disk though it was written, or where
        another run has taken the place of this one.
    ClusterError
        Where workers die under a task again and again for other reasons, or all have gone.
    """
    taken = np.zeros(len(shards), dtype=np.bool_)

    def take_once(index: int, payload: Payload) -> None:
        if not taken[index]:
            taken[index] = True
            take(shards[index], payload)

    def tell(text: str) -> None:
        on_event(Warned(text))

    work = partial(_work, task, shards, journal)
    todo = _missing(journal, shards, take_once)
    for number in range(_ROUNDS):
        if not len(todo):
            return
        if number:
            tell(f"{_count(todo)} of stage {name} are not on disk as they were written: they are made again")
        if client is None:
            results = _run_here(work, todo, file, tell)
        else:
            results = Dispatch(client, work, todo, shards, name, file, tell).results()
        with closing(results) as finished:
            for index, payload in finished:
                take_once(index, payload)
                on_done(shards[index], payload)
        todo = _lost(journal, shards, take_once, client, tell)
    if len(todo):
        raise _not_on_disk(name, journal, shards, todo)


def _not_on_disk(name: str, journal: Journal, shards: Sequence[Shard], todo: Numbers) -> StoreError:
    return StoreError(
        f"{_count(todo)} of stage {name} were written, and are not on disk as they were written",
        str(journal.folder.parent),
        "the files that the journal names",
        f"none, or others, for frames {shards[todo[0]].start} to {shards[todo[0]].stop - 1}",
        "Check this disk and its connection, and run again",
    )


def _missing(journal: Journal, shards: Sequence[Shard], take: Callable[[int, Payload], None]) -> Numbers:
    """Hand on the payloads of the shards that are done, and on disk; return the others."""
    missing = np.ones(len(shards), dtype=np.bool_)
    for index, payload, _ in journal.sound(shards):
        missing[index] = False
        take(index, payload)
    return np.flatnonzero(missing)


def _lost(
    journal: Journal, shards: Sequence[Shard], take: Callable[[int, Payload], None], client: Client | None, tell: Tell
) -> Numbers:
    """Return which shards are not on disk, though all were reported done.

    What another machine wrote can take a while to be seen on a network disk: a cluster's shards are looked for again.
    """
    lost = _missing(journal, shards, take)
    for number, seconds in enumerate(_looks(client)):
        if not len(lost):
            break
        if number == len(_LOOK_AGAIN_S):
            tell(
                f"{_count(lost)} are not to be seen at {journal.folder.parent}, though they were written:"
                f" they are looked for again for {sum(_FAR_LOOK_AGAIN_S):.0f} s"
            )
        sleep(seconds)
        lost = _missing(journal, shards, take)
    return lost


def _looks(client: Client | None) -> tuple[float, ...]:
    """Return the waits before each further look, in s; the workers and this process see the same disk, or may not."""
    if client is None:
        return ()
    far = {host_of(worker) for worker in client.nthreads()} - {*_HERE}
    return (*_LOOK_AGAIN_S, *(_FAR_LOOK_AGAIN_S if far else ()))


def _count(shards: Numbers) -> str:
    return f"{len(shards)} shard{'s' if len(shards) != 1 else ''}"


def _work(
    task: Callable[[Shard], Payload], shards: Sequence[Shard], journal: Journal, batch: Numbers
) -> tuple[list[Payload], float]:
    """Do the shards of a batch until its time is up; return the payloads of those that are done, and the seconds."""
    began = perf_counter()
    payloads = []
    with journal.batch() as done:
        for index in batch.tolist():
            payloads.append(task(shards[index]))
            done(shards[index], payloads[-1])
            if perf_counter() - began > BATCH_S:
                break
    return payloads, perf_counter() - began


def _run_here(work: Work, todo: Numbers, file: str, tell: Tell) -> Finished:
    """Do the shards one after the other in this process; try again what met an error that may pass."""
    for k in range(len(todo)):
        troubles: list[Trouble] = []
        while (payloads := _tried(work, todo[k : k + 1], file, troubles, tell)) is None:
            sleep(wait_s(len(troubles)))
        yield int(todo[k]), payloads[0]


def _tried(work: Work, batch: Numbers, file: str, troubles: list[Trouble], tell: Tell) -> list[Payload] | None:
    """Return the payloads of a batch; None where it met one more of its troubles, and is to be tried again."""
    try:
        return work(batch)[0]
    except Exception as error:
        met = trouble(error, Place(), file)
        if met is None or not met.passes:
            raise
        troubles.append(met)
        if is_hopeless(troubles, [""]):
            raise met.error from error
        if len(troubles) == 1:
            tell(f"{met}; it is tried again")
        return None
