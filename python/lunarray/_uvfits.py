"""Visibilities as UVFITS and as measurement sets, by pyuvdata, with positions of antennas by integration beside them."""

import os
import tempfile

import numpy as np

from ._native import Error
from ._uvh5 import TRUTH_ABOUT, offline, to_uvdata, truth_of
from ._write import needed, writing

#: Name of the extension, or the subtable.
BESIDE = "LUNARRAY"


def write_uvfits(downlink, path, channel, phase_centre):
    """Writes a file; see ``Downlink.write_uvfits``."""
    fits = needed("astropy.io.fits", "uvh5")
    with writing(path, downlink.path, b"SIMPLE  =", "UVFITS") as unfinished:
        made, rows = to_uvdata(downlink, channel, phase_centre)
        with offline():
            made.write_uvfits(unfinished, run_check=False)
        columns, attributes = truth_of(rows, downlink.instrument)
        forms = {1: "D", 2: "3D"}
        table = fits.BinTableHDU.from_columns(
            [fits.Column(name, forms[values.ndim], array=values.astype(float)) for name, values in columns.items()], name=BESIDE
        )
        for word, value in zip(WORDS, attributes.values()):
            table.header[word] = value
        table.header["COMMENT"] = TRUTH_ABOUT
        with fits.open(unfinished, mode="append") as file:
            file.append(table)
    return len(rows)


#: Keywords of name, epoch, radius, antenna and whether there is noise.
WORDS = ("INSTRUME", "EPOCHTAI", "MOONRAD", "ANTENNA", "NOISLESS")


def uvfits_truth(path):
    """What ``write_uvfits`` wrote beside; None without it."""
    from astropy.io import fits

    with fits.open(path) as file:
        if BESIDE not in file:
            return None
        table = file[BESIDE]
        columns = {name: np.array(table.data[name], float) for name in table.columns.names}
        names = ("name", "epoch_tai_s", "moon_radius_m", "antenna", "noiseless")
        return {**columns, **{name: table.header[word] for name, word in zip(names, WORDS) if word in table.header}}


def write_ms(downlink, path, channel, phase_centre):
    """Writes a measurement set; see ``Downlink.write_ms``."""
    tables = _casacore()
    path = os.fsdecode(path).rstrip("/")
    if os.path.lexists(path):
        raise Error(f"{path} is there: expected a new name for a measurement set")
    folder, name = os.path.split(os.path.abspath(path))
    if not os.path.isdir(folder):
        raise Error(f"{path}: expected a folder that is there; {folder} is none")
    # Casacore writes no Stokes I: XX and YY of an unpolarised sky are both I = (XX + YY) / 2.
    made, rows = to_uvdata(downlink, channel, phase_centre, ("xx", "yy"))
    with tempfile.TemporaryDirectory(prefix=f".{name}.", suffix=".partial", dir=folder) as beside:
        unfinished = os.path.join(beside, name)
        with offline():
            made.write_ms(unfinished, run_check=False)
        columns, attributes = truth_of(rows, downlink.instrument)
        described = [
            tables.makescacoldesc(name, 0.0) if values.ndim == 1 else tables.makearrcoldesc(name, 0.0, 1, [3])
            for name, values in columns.items()
        ]
        inner = os.path.join(unfinished, BESIDE)
        with tables.table(inner, tables.maketabdesc(described), nrow=len(rows), ack=False) as table:
            for name_, values in columns.items():
                table.putcol(name_, values.astype(float))
            table.putkeywords({"about": TRUTH_ABOUT, **attributes})
        with tables.table(unfinished, readonly=False, ack=False) as table:
            table.putkeyword(BESIDE, f"Table: {inner}")
        os.replace(unfinished, path)
    return len(rows)


def _casacore():
    """Its tables. It is no dependency, as it has no wheels for some systems."""
    try:
        from casacore import tables
    except ImportError as error:
        raise ImportError(f"{error}: pip install python-casacore brings it", name="casacore") from error
    return tables


def ms_truth(path):
    """What ``write_ms`` wrote beside; None without it."""
    if not os.path.isdir(os.path.join(path, BESIDE)):
        return None
    tables = _casacore()
    with tables.table(os.path.join(path, BESIDE), ack=False) as table:
        return {**{name: table.getcol(name) for name in table.colnames()}, **table.getkeywords()}
