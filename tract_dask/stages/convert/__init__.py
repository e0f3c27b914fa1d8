"""Stage convert: a movie in any format becomes a Zarr store."""
