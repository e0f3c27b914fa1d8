"""Shards, keys, destinations and full disks."""

from __future__ import annotations

import errno
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tract_dask.errors import DestinationError, StoreError
from tract_dask.settings import FitSettings
from tract_dask.store import disk, files, keys, metadata, provenance
from tract_dask.store.journal import Journal
from tract_dask.store.keys import counted
from tract_dask.store.shards import Shard, split


@given(n_frames=st.integers(1, 5000), per_shard=st.integers(1, 600))
def test_every_frame_is_in_exactly_one_shard(n_frames, per_shard):
    shards = split(n_frames, per_shard)
    frames = [frame for shard in shards for frame in range(shard.start, shard.stop)]
    assert frames == list(range(n_frames))
    assert [shard.index for shard in shards] == list(range(len(shards)))


def test_a_place_whose_name_is_not_utf8_is_refused(tmp_path):
    with pytest.raises(DestinationError, match=r"caf\\udce9.*not UTF-8"):
        metadata.check_destination(tmp_path / os.fsdecode(b"caf\xe9") / "movie.zarr")


def test_keys_tell_settings_apart_and_parts_from_each_other():
    key = keys.stage_key
    assert key("fit", counted("fit", fit=FitSettings())) == key("fit", counted("fit", fit=FitSettings()))
    assert key("fit", counted("fit", fit=FitSettings())) != key("fit", counted("fit", fit=FitSettings(threshold=3.0)))
    assert key("fit", "ab", "c") != key("fit", "a", "bc")
    assert key("fit", "ab") != key("sum", "ab")


def test_a_fingerprint_changes_with_the_file(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"1" * 100)
    first = provenance.fingerprint(path)
    assert provenance.fingerprint(path) == first
    path.write_bytes(b"1" * 99 + b"2")
    assert provenance.fingerprint(path) != first


def test_the_journal_remembers_and_forgets_other_keys(tmp_path):
    journal = Journal(tmp_path / "j", "key")
    journal.record(Shard(3, 30, 40), {"fits": 5})
    assert Journal(tmp_path / "j", "key").done() == {3: {"fits": 5}}
    assert Journal(tmp_path / "j", "other").done() == {}


def test_a_destination_that_holds_something_else_is_refused(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(DestinationError, match="already holds other data"):
        metadata.check_destination(tmp_path / "mine")
    with pytest.raises(DestinationError, match="cannot be written"):
        metadata.check_destination(tmp_path / "mine" / "thesis.txt" / "movie.zarr")
    metadata.check_destination(tmp_path / "new" / "movie.zarr")


def test_a_small_disk_is_refused_with_both_numbers(tmp_path):
    with pytest.raises(DestinationError, match=r"Expected about 1000000000\.0 GB free; got"):
        disk.check_free_space(tmp_path / "x", 10**18)


def test_a_full_disk_says_so(tmp_path):
    with pytest.raises(StoreError, match="what is done is kept"), files.disk_errors(tmp_path):
        raise OSError(errno.ENOSPC, "No space left on device")
