"""What local workers have in memory before they are forked: all that they import, and a compiler ready to load kernels.

Imported by the process from which they are forked (:mod:`tract_dask.cluster.forkserver`), and by nothing else. A worker
by itself would need a second for its first kernel, in which Numba sets itself up.
"""

from ..cluster.forkserver import uncollected

with uncollected():
    import distributed  # noqa: F401

    from ..kernels.registration import load_kernels
    from ..stages import sum as _sum  # noqa: F401
    from ..stages.convert import stage as _convert  # noqa: F401
    from ..stages.drift import stage as _drift  # noqa: F401
    from ..stages.fit import stage as _fit  # noqa: F401

    load_kernels()
