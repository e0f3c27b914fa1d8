"""The report of a run: one HTML file with its numbers, its warnings in plain words, and figures to look at closely."""

from .page import is_current, write_report

__all__ = ["is_current", "write_report"]
