"""Wiener filter after Kilaas: keeps what stands out of the radial background of the frame's own power spectrum.

R. Kilaas, J. Microscopy 190 (1998) 45: with the Fourier transform F of the image and the power |B|^2 of what is not
periodic in it, which depends on the distance from the origin alone, the filtered transform is F times

    (|F|^2 - |B|^2) / |F|^2, or 0 where that is negative.

The background is estimated from the image itself. In noise, the power in a ring of the transform is distributed
exponentially, so that its mean is the median over log 2, whatever the few Bragg reflections in the ring hold; then
everything above ten times that is a reflection, and the background is the mean of the rest, corrected for what noise
had there.

The filter does not remove noise, which exceeds its own mean at random: of white noise a share of E1(1) = 0.219 of the
variance stays (E1 is the exponential integral). It is therefore followed by Butterworth's low pass, as in the programs
that offer it (D. R. G. Mitchell's script for DigitalMicrograph).

What it keeps is the periodic part of the frame: a column off its lattice site loses brightness to the empty site, and
is drawn towards it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .magnitude import unit_of

Array = npt.NDArray[Any]

_REFLECTION = 10.0
"""Power of a reflection, in units of the background's mean; noise exceeds it with a probability of 5e-5."""


def wiener(image: Array, background: float = 1.0, cutoff: float = 0.3) -> npt.NDArray[np.float32]:
    """Return the image after Kilaas's Wiener filter; its mean stays.

    Parameters
    ----------
    image
        (ny, nx), finite; a single NaN leaves nothing but NaN.
    background
        How many times the background is subtracted: 1 is Kilaas's; more leaves less noise, and less of all that is
        not periodic.
    cutoff
        Frequency at which the low pass halves the power, in units of Nyquist's (half a cycle a pixel); its order is 2.
        Infinity for none.

    Returns
    -------
    (ny, nx) float32.

    Raises
    ------
    ValueError
        If the image is not two-dimensional, ``background`` is negative, or ``cutoff`` is not positive.
    """
    if image.ndim != 2 or not image.size:
        raise ValueError(f"image must be (ny, nx) with pixels, got {image.shape}")
    if not background >= 0:
        raise ValueError(f"background must be at least 0, got {background}")
    if not cutoff > 0:
        raise ValueError(f"cutoff must be positive, got {cutoff}")
    unit = unit_of(image)
    pixels = np.asarray(image if unit == 1 else image / unit, dtype=np.float32)
    transform = np.fft.rfft2(pixels)
    power = transform.real**2 + transform.imag**2
    level = np.float32(background) * radial_background(power, image.shape)
    frequency = np.hypot(np.fft.fftfreq(image.shape[0])[:, None], np.fft.rfftfreq(image.shape[1]))
    low_pass = 1 / np.sqrt(1 + (2 * frequency / cutoff) ** 4, dtype=np.float32)
    with np.errstate(invalid="ignore"):
        gain = np.maximum(power - level, 0) / np.maximum(power, np.finfo(np.float32).tiny)
    gain[0, 0] = 1
    filtered = np.fft.irfft2(transform * gain * low_pass, s=image.shape)
    return np.asarray(filtered if unit == 1 else filtered * unit, dtype=np.float32)


def radial_background(power: Array, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Return the radial background of a power spectrum, reflections left out.

    Parameters
    ----------
    power
        (ny, nx // 2 + 1), of a real image of ``shape`` (ny, nx), as ``numpy.fft.rfft2`` orders it.

    Returns
    -------
    (ny, nx // 2 + 1) float32: the ring's background where the pixel is, interpolated between rings.
    """
    ny, nx = shape
    rings = max(ny, nx)
    distance = np.hypot(np.fft.fftfreq(ny)[:, None], np.fft.rfftfreq(nx)).astype(np.float32) * np.float32(rings)
    ring = np.rint(distance).astype(np.intp).ravel()
    ring[0] = ring.max() + 1  # the mean of the image is no part of any ring
    values = power.ravel()
    first = _ring_medians(values, ring) / np.log(2)
    kept = values <= _REFLECTION * first[ring]
    count = np.bincount(ring[kept], minlength=len(first))
    sums = np.bincount(ring[kept], values[kept], minlength=len(first))
    cut = 1 - _REFLECTION / np.expm1(_REFLECTION)  # mean of an exponential distribution that ends there
    mean = np.where(count > 0, sums / np.maximum(count, 1) / cut, first)[:-1]
    known = np.flatnonzero(np.bincount(ring, minlength=len(first))[:-1])
    return np.asarray(np.interp(distance, known, mean[known]), dtype=np.float32)


def _ring_medians(values: Array, ring: npt.NDArray[np.intp]) -> npt.NDArray[np.float64]:
    """Return the median of the values in each ring; 0 for one without any."""
    count = np.bincount(ring)
    order = np.lexsort((values, ring))
    first = np.cumsum(count) - count
    low, high = first + np.maximum(count - 1, 0) // 2, first + np.minimum(count // 2, np.maximum(count - 1, 0))
    ordered = values[order]
    last = len(values) - 1
    medians = (ordered[np.minimum(low, last)] + ordered[np.minimum(high, last)]) / 2
    return np.where(count > 0, medians, 0).astype(np.float64)
