"""The total intensity of data of pyuvdata, in K sr."""

import numpy as np

from ._import import jansky_per_k_sr
from ._native import Error

#: Pairs of polarisations, as pyuvdata numbers them, whose sum or mean is the total intensity; and that itself.
CROSSED, INTENSITY = ((-5, -6), (-1, -2)), 1


def total_intensity(data, pol_convention):
    """Values, flags and samples of the total intensity: a row a time and pair, a column a channel."""
    if getattr(data, "flex_spw_polarization_array", None) is not None:
        raise Error("polarisation by spectral window: expected data after UVData.remove_flex_pol")
    found = [int(pol) for pol in data.polarization_array]
    stated = pol_convention or getattr(data, "pol_convention", None)
    if INTENSITY in found:
        used, factor = [found.index(INTENSITY)], 1.0
    else:
        used = next(([found.index(pol) for pol in pair if pol in found] for pair in CROSSED if set(pair) & set(found)), [])
        if not used:
            raise Error(f"polarisations {found}: expected Stokes I, or XX and YY, or RR and LL")
        if stated not in ("sum", "avg"):
            raise Error(
                f'pol_convention = {stated!r}, which the data do not say: expected "sum" (I = XX + YY, as pyuvsim has it) or "avg" '
                "(I = (XX + YY) / 2)"
            )
        factor = 2.0 if stated == "sum" else 1.0
    values = factor * data.data_array[:, :, used].mean(axis=2)
    samples = data.nsample_array[:, :, used]
    # Of sums of two polarisations both halves count, and one without samples has no value.
    return values, data.flag_array[:, :, used].any(axis=2) | ~(samples > 0).all(axis=2), samples.mean(axis=2)


def in_k_sr(values, data, frequency_hz):
    """Values in K sr."""
    units = {"jy": jansky_per_k_sr(frequency_hz), "k str": np.ones(len(frequency_hz))}
    per_k_sr = units.get(str(data.vis_units).lower())
    if per_k_sr is None:
        raise Error(
            f'vis_units = {data.vis_units!r}: expected calibrated data, "Jy" or "K str"; of a measurement set of another program that is '
            'calibrated in Jy: data = UVData.from_file(.., data_column="CORRECTED_DATA"), then data.vis_units = "Jy"'
        )
    return values / per_k_sr
