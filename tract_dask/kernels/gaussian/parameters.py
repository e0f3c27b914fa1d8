"""The seven parameters of Equation 1, their order and units."""

from __future__ import annotations

PARAMETERS = ("amplitude", "x", "y", "sigma_a", "sigma_b", "theta", "background")
"""The seven parameters of Equation 1, in the order that is used everywhere."""

AMPLITUDE, X, Y, SIGMA_A, SIGMA_B, THETA, BACKGROUND = range(len(PARAMETERS))

PARAMETER_UNITS = ("counts", "px", "px", "px", "px", "rad", "counts")
