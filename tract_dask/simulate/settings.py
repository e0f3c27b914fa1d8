"""What a multislice simulation shows, and with which microscope."""

from __future__ import annotations

from dataclasses import dataclass

from ..settings.declare import Settings, setting


@dataclass(frozen=True)
class Microscope(Settings):
    """Illumination, lens aberrations, partial coherence, vibration; the defaults are the paper's bright-atom imaging.

    ``defocus_nm`` above 0 is overfocus. With a negative ``spherical_um`` it makes atoms bright (negative spherical
    aberration imaging: C. L. Jia, M. Lentzen and K. Urban, Microsc. Microanal. 10 (2004) 174).

    Partial coherence is the product of two envelopes on the wave (quasi-coherent; E. J. Kirkland, Advanced Computing in
    Electron Microscopy, 2010, section 3.2), which hardly matters where the scattered waves are weak beside the direct
    one. ``focal_spread_nm`` is that book's half-width at 1/e, as abTEM takes it: the standard deviation times sqrt(2).
    """

    energy_kev: float = setting(300.0, "Energy of the electrons", unit="keV", low=20, high=3000)
    defocus_nm: float = setting(7.8, "Defocus, positive for overfocus (C10)", unit="nm", low=-10_000, high=10_000)
    spherical_um: float = setting(-20.0, "Spherical aberration of third order (C30)", unit="um", low=-1e4, high=1e4)
    fifth_order_mm: float = setting(5.0, "Spherical aberration of fifth order (C50)", unit="mm", low=-1e3, high=1e3)
    focal_spread_nm: float = setting(
        1.0, "Half-width at 1/e of the distribution of defocus", unit="nm", low=0, high=1000
    )
    angular_spread_mrad: float = setting(
        0.2, "Standard deviation of the illumination's angles", unit="mrad", low=0, high=10
    )
    aperture_mrad: float = setting(60.0, "Half-angle of the objective aperture", unit="mrad", low=1, high=200)
    vibration_pm: float = setting(
        15.0, "Standard deviation per axis of the image's vibration", unit="pm", low=0, high=1000
    )
    thermal_pm: float = setting(
        7.0,
        "Thermal displacement of the atoms, rms per axis, smeared into the potential",
        unit="pm",
        low=0,
        high=100,
    )


@dataclass(frozen=True)
class SpecimenSettings(Settings):
    """What is under the beam; :func:`tract_dask.simulate.structures.specimen_of` makes it."""

    structure: str = setting(
        "ceo2", "ceo2, a surface with a step (for a table, a slab of even thickness), or a file that ASE reads"
    )
    height_pm: float = setting(2000.0, "Height of the step's field, or of a block", unit="pm", low=1, high=1e5)
    width_pm: float = setting(2000.0, "Width of the step's field, or of a block", unit="pm", low=1, high=1e5)
    n_periods: int = setting(6, "Thickness of a block, in periods along the beam", low=1, high=1000)
    zone_axis: tuple[int, ...] = setting(
        (), "Lattice direction [uvw] along the beam, to cut a block from a file's crystal; unset: the unchanged file"
    )
    up: tuple[int, ...] = setting((), "Lattice direction [uvw] upwards in the image; unset: any")


PRESETS = {"paper": Microscope(), "supplement": Microscope(spherical_um=30.0)}
"""``paper``: the contrast of the paper's images, with the spherical aberration of its methods (about -20 um).
``supplement``: the parameters of its supplement to the letter (+30 um), which do not give bright atoms. What neither
names (aperture, angular spread, vibration, thermal displacement) is the same in both."""
