"""What local workers have in memory before they are forked: all that they import, and a compiler ready to load kernels.

Imported by the process from which they are forked (:mod:`tract_dask.forkserver`), and by nothing else. A worker by
itself would need a second for its first kernel, in which Numba sets itself up.
"""

from .lazy import uncollected

with uncollected():
    import distributed  # noqa: F401

    from . import stages  # noqa: F401
    from .kernels.registration import load_kernels

    load_kernels()
