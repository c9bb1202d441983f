"""Files of ``Downlink.write_uvh5``, which hold what a downlink says."""

import numpy as np

from ._import import SPEED_OF_LIGHT_M_S, Instrument, Part
from ._native import Error
from ._stokes import in_k_sr, total_intensity
from ._tracks import Track


def of_own(data, truths):
    """Parts, the track and the instrument of files with the group ``lunarray``."""
    first = truths[0]
    said = [name for name in ("epoch_tai_s", "moon_radius_m", "antenna") if any(name not in truth for truth in truths)]
    if said:
        raise Error(f"the group lunarray lacks {', '.join(said)}: expected a file that this version of write_uvh5 made")
    antennas = len(data[0].telescope.antenna_numbers)
    parts, known = [], []
    for one, truth in zip(data, truths):
        is_same = all(truth[name] == first[name] for name in ("epoch_tai_s", "moon_radius_m", "antenna"))
        if not is_same or len(one.telescope.antenna_numbers) != antennas:
            raise Error("files of different arrays or epochs: expected channels of one downlink")
        frequency_hz = np.asarray(one.freq_array, float)
        values, flagged, _ = total_intensity(one, None)
        values = in_k_sr(values, one, frequency_hz)
        values = values * np.exp(2j * np.pi * one.uvw_array[:, 2:3] * frequency_hz / SPEED_OF_LIGHT_M_S)
        i, j = one.ant_1_array - 1, one.ant_2_array - 1
        width_hz = np.broadcast_to(np.asarray(one.channel_width, float), frequency_hz.shape)
        duration_s = np.asarray(one.integration_time, float)
        weight = truth["weight"][:, None].astype(float)
        parts.append(Part(frequency_hz, width_hz, i, j, truth["epoch_tai_s"], truth["time_s"], duration_s, values, weight, flagged))
        known += [(truth["time_s"], i, truth["position_1_m"]), (truth["time_s"], j, truth["position_2_m"])]
    track = Track(*(np.concatenate(column) for column in zip(*known)), antennas)
    antenna, noiseless = str(first["antenna"]), bool(first["noiseless"])
    return parts, track, Instrument(str(first["name"]), antennas, float(first["moon_radius_m"]), antenna, noiseless)
