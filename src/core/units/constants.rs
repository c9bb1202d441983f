//! Physical constants, each with its source.

/// Speed of light in vacuum, m/s (SI, exact).
pub const SPEED_OF_LIGHT_M_S: f64 = 299_792_458.0;

/// Boltzmann constant, J/K (SI, exact).
pub const BOLTZMANN_J_K: f64 = 1.380_649e-23;

/// Mean radius of the Moon, m (IAU 2015; the paper, Sect. 3.2).
pub const MOON_RADIUS_M: f64 = 1_737_100.0;

/// How far the Moon's ground departs from its mean sphere, m: 9.1 km below to 10.8 km above (LOLA; Smith et al. 2010).
#[doc(hidden)]
pub const MOON_RELIEF_M: f64 = 12e3;
/// GM of the Moon, m^3/s^2 (DE440).
pub const MOON_GM_M3_S2: f64 = 4.902_800_118e12;

/// One Julian day, s.
pub const DAY_S: f64 = 86_400.0;

/// One Julian year, s.
pub const YEAR_S: f64 = 365.25 * DAY_S;

/// Sidereal month: the period of the Earth's direction as seen from the Moon, s.
#[doc(hidden)]
pub const SIDEREAL_MONTH_S: f64 = 27.321_661 * DAY_S;

/// HEALPix value of a pixel without data, K.
#[doc(hidden)]
pub const HEALPIX_UNSEEN: f64 = -1.637_5e30;
