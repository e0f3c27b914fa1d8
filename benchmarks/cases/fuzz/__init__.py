"""Mutated files through the readers, with limits on time and memory."""
