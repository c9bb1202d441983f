"""What several tests need."""

import sys
from pathlib import Path

import pytest

import lunarray

REPOSITORY = Path(__file__).resolve().parents[2]
# The independent readers of the packets.
sys.path.insert(0, str(REPOSITORY / "tests/python"))

#: The quicklook, made small: seconds.
SMALL = {
    "sky.nside": 8,
    "spacecraft.channels_hz": [1e6, 3e6],
    "spacecraft.every_nth_window": 300,
    "spacecraft.every_nth_integration": 2,
    "spacecraft.baseline_wavelengths_max": 16.0,
    "map.nside": 4,
    "map.engine": "pixel",
    "map.epsilon": 1e-4,
    "products.pictures": False,
}


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """A small run of the whole chain."""
    return lunarray.run(set=SMALL, out=tmp_path_factory.mktemp("small"))
