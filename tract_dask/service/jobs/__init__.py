"""The jobs on disk: what a job is, its states, and the store that is their truth."""
