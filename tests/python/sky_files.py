"""Map files as healpy writes and reads them.

usage: sky_files.py write FOLDER   healpy writes maps and, beside each, its values (RING, float64, raw)
       sky_files.py read FOLDER    healpy reads what is there and compares with the values beside it
       sky_files.py statistics FILE...   mean, std and 5/50/95 % of maps, one line each
"""

import sys
import warnings
from pathlib import Path

import healpy as hp
import numpy as np
from astropy.io import fits


def write(folder):
    rng = np.random.default_rng(1)
    for nside in (4, 32):
        npix = 12 * nside**2
        full = rng.normal(3e5, 1e5, npix)
        holes = full.copy()
        holes[rng.random(npix) < 0.3] = hp.UNSEEN
        for dtype in (np.float32, np.float64, np.int16, np.int64):
            for nest in (False, True):
                for partial in (False, True):
                    for rows in (False, True):
                        values = (holes if partial else full).copy()
                        if dtype in (np.int16, np.int64):
                            values = np.round(values / 100)
                            if partial:
                                values[holes == hp.UNSEEN] = hp.UNSEEN
                        if dtype == np.float32:
                            values = np.where(values == hp.UNSEEN, hp.UNSEEN, values.astype(dtype).astype(float))
                        coord = "EGC"[(nside + nest + partial) % 3]
                        name = f"{nside}_{dtype.__name__}_{nest}_{partial}_{rows}_{coord}"
                        given = hp.reorder(values, r2n=True) if nest else values
                        hp.write_map(str(folder / f"{name}.fits"), given, nest=nest, dtype=dtype, fits_IDL=rows,
                                     coord=coord, partial=partial, column_units="K")
                        values.astype("<f8").tofile(folder / f"{name}.raw")
    # Three columns, of which the tests read the last.
    maps = [rng.normal(size=192) for _ in range(3)]
    hp.write_map(str(folder / "columns_E.fits"), maps, dtype=np.float64, coord="E")
    maps[2].astype("<f8").tofile(folder / "columns_E.raw")


def read(folder):
    files = sorted(folder.glob("*.fits"))
    assert files
    for file in files:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with fits.open(file) as opened:
                opened.verify("exception")
                header = opened[1].header
        values = np.fromfile(file.with_suffix(".raw"), "<f8")
        nside = hp.npix2nside(len(values))
        found = hp.read_map(str(file))
        expected = values.astype(found.dtype)
        assert np.array_equal(found, expected), file
        assert header["CREATOR"].startswith("lunarray "), file
        assert header["PIXTYPE"] == "HEALPIX" and header["NSIDE"] == nside, file
        assert header["COORDSYS"] in "GEC" and header["TUNIT1" if header["TFIELDS"] == 1 else "TUNIT2"] == "K", file
        # healpy's own file of the same map differs in no card and no byte.
        own = file.with_suffix(".own")
        nest = header["ORDERING"] == "NESTED"
        partial = header["OBJECT"] == "PARTIAL"
        given = hp.reorder(expected, r2n=True) if nest else expected
        hp.write_map(str(own), given, nest=nest, coord=header["COORDSYS"], partial=partial, column_units="K",
                     column_names=["TEMPERATURE"], dtype=found.dtype, overwrite=True,
                     extra_header=[("CREATOR", header["CREATOR"], "program"), ("SEED", 17, "seed"), ("FREQ", 1e7, "Hz")])
        assert own.read_bytes() == file.read_bytes(), file
    print(len(files))


def statistics(files):
    for file in files:
        values = hp.read_map(file).astype(float)
        print(values.mean(), values.std(), *np.percentile(values, [5, 50, 95]))


if __name__ == "__main__":
    task, *rest = sys.argv[1:]
    {"write": lambda: write(Path(rest[0])), "read": lambda: read(Path(rest[0])), "statistics": lambda: statistics(rest)}[task]()
