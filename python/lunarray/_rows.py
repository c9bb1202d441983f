"""The layout of rows that the native module writes (``put`` in ``python/src/downlink.rs``)."""

import numpy as np

_FIELDS = [
    ("time_s", "f8"),
    ("tai", "M8[ns]"),
    ("utc", "M8[ns]"),
    ("dt_s", "f8"),
    ("i", "u1"),
    ("j", "u1"),
    ("flag", "u1"),
    ("_", "u1"),
    ("weight", "f4"),
    ("uvw_m", "f8", (3,)),
    ("r_i_m", "f8", (3,)),
    ("r_j_m", "f8", (3,)),
    ("value_k_sr", "c8"),
    ("value_jy", "c16"),
]
_WHOLE = np.dtype(_FIELDS)
_NAMES = [name for name in _WHOLE.names if name != "_"]

#: One visibility. All fields but the byte that aligns them.
VISIBILITY = np.dtype(
    {
        "names": _NAMES,
        "formats": [_WHOLE.fields[name][0] for name in _NAMES],
        "offsets": [_WHOLE.fields[name][1] for name in _NAMES],
        "itemsize": _WHOLE.itemsize,
    }
)

#: One auto-correlation.
AUTO = np.dtype(
    [
        ("time_s", "f8"),
        ("tai", "M8[ns]"),
        ("utc", "M8[ns]"),
        ("dt_s", "f8"),
        ("satellite", "u1"),
        ("frequency_hz", "f8"),
        ("power_k_sr", "f4"),
        ("weight", "f4"),
        ("flag", "u1"),
    ]
)
