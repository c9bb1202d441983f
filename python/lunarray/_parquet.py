"""Visibilities as Parquet, by pyarrow."""

import json

import numpy as np

from ._write import needed, writing

#: Units of the columns.
UNITS = {
    "time_s": "s since the mission's epoch, middle of the integration",
    "tai": "TAI",
    "utc": "UTC",
    "dt_s": "s",
    "i": "satellite, from 1",
    "j": "satellite, from 1",
    "re_k_sr": "K sr",
    "im_k_sr": "K sr",
    "re_jy": "Jy",
    "im_jy": "Jy",
    "weight": "inverse variance of the real part, (K sr)^-2",
    "flag": "0 for a good one",
}


def to_table(downlink, channel):
    """The visibilities of a channel as a ``pyarrow.Table``."""
    pa = needed("pyarrow", "parquet")

    rows = downlink.visibilities(channel)
    columns = {name: np.ascontiguousarray(rows[name]) for name in ("time_s", "tai", "utc", "dt_s", "i", "j")}
    units = dict(UNITS)
    for names, values in (("uvw", rows["uvw_m"]), (("x_i", "y_i", "z_i"), rows["r_i_m"]), (("x_j", "y_j", "z_j"), rows["r_j_m"])):
        for axis, name in enumerate(names):
            columns[f"{name}_m"] = np.ascontiguousarray(values[:, axis])
            units[f"{name}_m"] = "m, Moon-centred ecliptic axes; NaN where the file has no positions"
    for unit in ("k_sr", "jy"):
        columns[f"re_{unit}"] = np.ascontiguousarray(rows[f"value_{unit}"].real)
        columns[f"im_{unit}"] = np.ascontiguousarray(rows[f"value_{unit}"].imag)
    columns["weight"], columns["flag"] = (np.ascontiguousarray(rows[name]) for name in ("weight", "flag"))
    arrays = [pa.array(values) for values in columns.values()]
    fields = [
        pa.field(name, array.type, metadata={"unit": units[name]}) for (name, array) in zip(columns, arrays, strict=True)
    ]
    about = {
        "lunarray.channel": str(channel),
        "lunarray.frequency_hz": repr(float(downlink.channels_hz[channel])),
        "lunarray.instrument": json.dumps(downlink.instrument),
    }
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=about))


def write_parquet(downlink, path, channel):
    """Writes a file; see ``Downlink.write_parquet``."""
    parquet = needed("pyarrow.parquet", "parquet")
    with writing(path, downlink.path, b"PAR1", "Parquet") as unfinished:
        table = to_table(downlink, channel)
        parquet.write_table(table, unfinished)
    return len(table)
