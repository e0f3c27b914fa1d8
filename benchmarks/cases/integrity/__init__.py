"""Damage to the stores, and costs that grow with the number of frames, columns or tasks."""
