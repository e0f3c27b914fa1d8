"""What lies on disk: stores, tables, journals, and the files of a run."""
