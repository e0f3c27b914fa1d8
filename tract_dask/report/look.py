"""A look at the tracks when a run ends: what there is to know is kept with them, whether a page is wanted or not."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ..store import metadata
from ..store.run_folder import RunFolder
from .finding import Finding
from .findings import findings
from .page import is_current, run_key, write_page
from .survey import Survey, events_of, survey


def look(folder: Path, *, page: bool = True) -> tuple[list[Finding], bool]:
    """Return what there is to know of a finished run, and whether it was known before.

    The names of the warnings are an attribute of the tracks, ``findings``; ``none`` where there are none.

    Parameters
    ----------
    folder
        Of the run.
    page
        Also write ``report.html``, without the figures that take most of the time, where there is none of these tracks.

    Raises
    ------
    StoreError
        Where the folder has no finished tracks or no summed image, or the page cannot be written.
    """
    places, run = RunFolder(folder), None
    key, known = run_key(folder), metadata.attributes(places.results).get("findings") or {}
    if known.get("key") == key:
        found = [Finding(**values) for values in known["found"]]
    else:
        run = _survey(folder)
        found = findings(run)
        _keep(found, key, places.results)
    written = page and not is_current(folder)
    if written:
        write_page(run or _survey(folder), key, places.report, figures=False)
    return found, run is None and not written


def _survey(folder: Path) -> Survey:
    return survey(folder, events_of(RunFolder(folder).events))


def _keep(found: list[Finding], key: str, results: Path) -> None:
    names = ", ".join(finding.name for finding in found if finding.serious) or "none"
    values = [dataclasses.asdict(finding) for finding in found]
    metadata.update_attributes(results, plain={"findings": names}, findings={"key": key, "found": values})
