"""Stage fit: every column in every frame."""
