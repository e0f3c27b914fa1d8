"""Stage columns: where the atomic columns are in the summed image."""
