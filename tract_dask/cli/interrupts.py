"""Ctrl-C in a terminal: the first ends the work in good order, a second one soon after ends the process at once."""

from __future__ import annotations

import _thread
import logging
import os
import signal
import sys
import threading
from contextlib import suppress
from time import monotonic
from types import FrameType
from typing import TYPE_CHECKING

from ..errors import ExitCode

if TYPE_CHECKING:
    from collections.abc import Callable

SENTENCE = "Interrupted: what is done is kept, and the same command goes on from there."

_SOON_S = 20.0
_SHOW_CURSOR = "\x1b[?25h"
"""The display of progress hides it."""


def end_at_once(number: int = 0, frame: FrameType | None = None) -> None:
    """End the process, and with it all that it has started."""
    if psutil := sys.modules.get("psutil"):  # Dask has imported it, if there are workers: one that hangs ends too
        for child in psutil.Process().children(recursive=True):
            with suppress(psutil.Error):
                child.kill()
    cursor = _SHOW_CURSOR if sys.stderr.isatty() else ""
    os.write(2, f"{cursor}\n{SENTENCE}\n".encode())
    os._exit(ExitCode.INTERRUPTED)


class Interrupts:
    """Answers SIGINT: raises KeyboardInterrupt, and ends the process where that was asked for a moment ago."""

    def __init__(self) -> None:
        self._last = -_SOON_S

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Answer the signal."""
        if monotonic() - self._last < _SOON_S:
            end_at_once()
        self._last = monotonic()
        logging.disable(logging.CRITICAL)  # what is cut off complains, and says nothing new
        raise KeyboardInterrupt

    def lost(self, what: sys.UnraisableHookArgs, before: Callable[[sys.UnraisableHookArgs], object]) -> None:
        """Interrupt again where the interrupt came up in a place that can raise nothing, such as a callback."""
        if what.exc_type is KeyboardInterrupt:
            self._last = -_SOON_S
            _thread.interrupt_main()
        else:
            before(what)


def install(*, working: bool = True) -> None:
    """Answer Ctrl-C from now on; before there is any ``working`` it ends the process at once."""
    if threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # as shells start what runs in the background
        return
    if not working:
        signal.signal(signal.SIGINT, end_at_once)
        return
    answer, before = Interrupts(), sys.unraisablehook
    signal.signal(signal.SIGINT, answer)
    sys.unraisablehook = lambda what: answer.lost(what, before)
