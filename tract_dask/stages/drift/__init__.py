"""Stage drift: how far each frame lies from the first."""
