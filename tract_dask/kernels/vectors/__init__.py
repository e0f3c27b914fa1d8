"""Programs for the processor's vectors, traced from Python."""
