"""Numerical kernels: numpy and numba only, array in, array out."""
