"""Each fitter in a process of its own, with its own packages: this project's as well as its peers'.

A process runs ``python -m benchmarks.peers.NAME`` and imports nothing of this project, except for ``ours``.
"""
