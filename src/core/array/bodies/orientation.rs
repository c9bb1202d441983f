//! Orientation of the Moon by date: axes that are fixed to it.

use crate::array::axes::turned;
use crate::array::state::SatelliteState;
use crate::units::time_scales::Tai;
use crate::units::vector::{Vec3, add, cross, scale};

/// Arguments E1 to E13 of the series: degrees at J2000, and degrees a day.
const ARGUMENTS: [[f64; 2]; 13] = [
    [125.045, -0.052_992_1],
    [250.089, -0.105_984_2],
    [260.008, 13.012_000_9],
    [176.625, 13.340_715_4],
    [357.529, 0.985_600_3],
    [311.589, 26.405_708_4],
    [134.963, 13.064_993],
    [276.617, 0.328_714_6],
    [34.226, 1.748_487_7],
    [15.134, -0.158_976_3],
    [119.743, 0.003_609_6],
    [239.961, 0.164_357_3],
    [25.053, 12.959_008_8],
];

/// Degrees of the arguments' sines in the pole's right ascension and in the rotation angle, and of their cosines in the pole's
/// declination.
const AMPLITUDES: [[f64; 3]; 13] = [
    [-3.878_7, 3.561, 1.541_9],
    [-0.120_4, 0.120_8, 0.023_9],
    [0.07, -0.064_2, -0.027_8],
    [-0.017_2, 0.015_8, 0.006_8],
    [0.0, 0.025_2, 0.0],
    [0.007_2, -0.006_6, -0.002_9],
    [0.0, -0.004_7, 0.000_9],
    [0.0, -0.004_6, 0.0],
    [0.0, 0.002_8, 0.0],
    [-0.005_2, 0.005_2, 0.000_8],
    [0.0, 0.004, 0.0],
    [0.0, 0.001_9, 0.0],
    [0.004_3, -0.004_4, -0.000_9],
];

/// From the principal axes of inertia to the mean Earth and polar axes: turns about x, y and z, arc seconds, those of DE421
/// (Williams, Boggs and Folkner 2008, JPL IOM 335-JW,DB,WF-20080314-001). The axes of other ephemerides differ by up to 4".
const PRINCIPAL_TO_MEAN_ARCSEC: Vec3 = [-0.30, -78.56, -67.92];

/// Axes that are fixed to the Moon.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::array) enum MoonAxes {
    /// Of the mean rotation and the mean direction of the Earth, those of maps and selenographic coordinates.
    MeanEarth,
    /// The principal axes of inertia.
    Principal,
}

impl MoonAxes {
    /// The axes that a file names as CCSDS's registry or as NAIF's kernels do: `MOON_ME`, `MOON_PA421`, `MOON_ME_DE440_ME421`, `IAU_MOON`.
    pub(in crate::array) fn from_name(name: &str) -> Option<Self> {
        let of = |prefix: &str| {
            let rest = name.strip_prefix(prefix)?;
            let is_number = rest.len() == 3 && rest.bytes().all(|b| b.is_ascii_digit());
            (rest.is_empty() || is_number || rest.starts_with("_DE")).then_some(())
        };
        match name == "IAU_MOON" || of("MOON_ME").is_some() {
            true => Some(Self::MeanEarth),
            false => of("MOON_PA").map(|()| Self::Principal),
        }
    }
}

/// How the Moon is turned at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::array) struct Orientation {
    /// Its mean Earth and polar axes, on ecliptic axes of J2000.
    axes: [Vec3; 3],
    /// The vector of its rotation, rad/s, on ecliptic axes of J2000.
    rate_rad_s: Vec3,
}

impl Orientation {
    /// The orientation at a time: to 0.005 degrees from 2020 to 2040 (150 m on the surface), and its rate to 2e-10 rad/s.
    ///
    /// The formula of the IAU's working group on cartographic coordinates (Archinal et al. 2011, Celest. Mech. Dyn. Astr. 109, 101;
    /// their report of 2018 leaves it as it is): right ascension and declination of the pole, and the angle of the prime meridian.
    pub(in crate::array) fn at(time: Tai) -> Self {
        const DAY_S: f64 = 86_400.0;
        const CENTURY_DAYS: f64 = 36_525.0;
        // TT serves as TDB: in 2 ms the Moon turns by 3e-7 degrees.
        let t = time.tt_centuries();
        let days = t * CENTURY_DAYS;
        // Values, degrees, and rates, degrees a day.
        let mut ascension = [269.994_9 + 0.003_1 * t, 0.003_1 / CENTURY_DAYS];
        let mut meridian =
            [38.321_3 + days * (13.176_358_15 - 1.4e-12 * days), 13.176_358_15 - 2.8e-12 * days];
        let mut declination = [66.539_2 + 0.013 * t, 0.013 / CENTURY_DAYS];
        for ([zero, rate], [right, angle, up]) in ARGUMENTS.into_iter().zip(AMPLITUDES) {
            let (sin, cos) = (zero + rate * days).to_radians().sin_cos();
            let rate = rate.to_radians();
            for (sum, amplitude) in [(&mut ascension, right), (&mut meridian, angle)] {
                sum[0] += amplitude * sin;
                sum[1] += amplitude * cos * rate;
            }
            declination[0] += up * cos;
            declination[1] -= up * sin * rate;
        }
        let [(sin_a, cos_a), (sin_d, cos_d), (sin_w, cos_w)] =
            [ascension, declination, meridian].map(|[deg, _]| deg.to_radians().sin_cos());
        let pole = [cos_d * cos_a, cos_d * sin_a, sin_d];
        // The node of the Moon's equator on that of ICRF, from which the meridian is counted.
        let node = [-sin_a, cos_a, 0.0];
        let across = cross(pole, node);
        let x = add(scale(cos_w, node), scale(sin_w, across));
        let axes = [x, cross(pole, x), pole].map(|axis| turned(true, axis));
        let [a, d, w] = [ascension, declination, meridian].map(|[_, rate]| rate.to_radians() / DAY_S);
        let rate = add([0.0, 0.0, a], add(scale(-d, node), scale(w, pole)));
        Self { axes, rate_rad_s: turned(true, rate) }
    }

    /// A direction or position on the ecliptic axes, from one on the mean Earth and polar axes.
    fn mean_to_ecliptic(&self, [x, y, z]: Vec3) -> Vec3 {
        let [a, b, c] = self.axes;
        add(scale(x, a), add(scale(y, b), scale(z, c)))
    }

    /// A state on the ecliptic axes, which do not turn, from one on Moon-fixed axes, which do.
    pub(in crate::array) fn state(&self, axes: MoonAxes, fixed: SatelliteState) -> SatelliteState {
        let turn = |v: Vec3| match axes {
            MoonAxes::MeanEarth => self.mean_to_ecliptic(v),
            MoonAxes::Principal => self.mean_to_ecliptic(to_mean(v)),
        };
        let position_m = turn(fixed.position_m);
        let velocity_m_s = add(turn(fixed.velocity_m_s), cross(self.rate_rad_s, position_m));
        SatelliteState { position_m, velocity_m_s }
    }
}

/// From the principal axes of inertia to the mean Earth and polar axes.
fn to_mean(v: Vec3) -> Vec3 {
    let about = |axis: usize, v: Vec3| {
        let (sin, cos) = (PRINCIPAL_TO_MEAN_ARCSEC[axis] / 3600.0).to_radians().sin_cos();
        let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
        let mut out = v;
        out[next] = cos * v[next] + sin * v[last];
        out[last] = cos * v[last] - sin * v[next];
        out
    };
    about(0, about(1, about(2, v)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::time_scales::TimeScale;
    use crate::units::vector::{norm, sub};

    /// Dates (UTC), the axes MOON_ME_DE421 on those of ECLIPJ2000, and the vector of their rotation, 1e-6 rad/s.
    ///
    /// By NAIF's toolkit with JPL's DE421, whose lunar orientation is integrated: `pip install lunarsky spiceypy astropy`, `furnsh` of
    /// `moon_pa_de421_1900-2050.bpc` and `moon_080317.tf` in `lunarsky/data`, `pxform("MOON_ME_DE421", "ECLIPJ2000", et)` and
    /// `xf2rav(sxform("ECLIPJ2000", "MOON_ME_DE421", et))[1]` with et of `astropy.time.Time(date, scale="utc").tdb`.
    #[rustfmt::skip]
    const AXES: [(&str, [Vec3; 3], Vec3); 13] = [
        ("2020-01-01T00:00:00", [[-0.965_730_9, 0.258_295_6, -0.025_439_4], [-0.258_107_9, -0.966_059_5, -0.010_459_0], [-0.027_277_5, -0.003_534_5, 0.999_621_7]], [-0.071_17, -0.009_79, 2.660_97]),
        ("2021-06-10T11:00:00", [[-0.141_632_2, -0.989_904_2, 0.005_475_7], [0.989_587_3, -0.141_439_2, 0.026_681_9], [-0.025_638_0, 0.009_197_7, 0.999_629_0]], [-0.067_81, 0.024_77, 2.660_86]),
        ("2022-11-08T06:00:00", [[-0.787_247_9, -0.616_634_6, -0.001_576_1], [0.616_377_2, -0.786_988_4, 0.026_988_1], [-0.017_882_2, 0.020_274_9, 0.999_634_5]], [-0.048_95, 0.053_21, 2.660_84]),
        ("2024-03-01T00:00:00", [[0.690_861_8, 0.722_874_6, -0.012_735_3], [-0.722_936_9, 0.690_499_9, -0.023_918_6], [-0.008_496_4, 0.025_731_2, 0.999_632_8]], [-0.021_76, 0.068_93, 2.660_91]),
        ("2025-01-03T13:00:00", [[-0.880_760_0, 0.473_371_3, -0.013_468_0], [-0.473_562_1, -0.880_455_3, 0.023_182_8], [-0.000_883_9, 0.026_796_4, 0.999_640_5]], [-0.001_27, 0.072_29, 2.660_70]),
        ("2026-08-12T18:00:00", [[0.717_082_8, -0.696_960_8, 0.006_155_5], [0.696_854_3, 0.716_744_5, -0.025_911_3], [0.013_647_2, 0.022_870_0, 0.999_645_3]], [0.036_08, 0.062_59, 2.660_50]),
        ("2027-03-05T06:00:00", [[-0.648_431_5, 0.761_260_1, -0.004_436_7], [-0.761_069_0, -0.648_111_8, 0.026_926_8], [0.017_622_9, 0.020_836_8, 0.999_627_6]], [0.047_14, 0.054_69, 2.660_94]),
        ("2028-09-21T03:00:00", [[0.894_378_6, 0.446_541_1, -0.026_227_4], [-0.446_608_5, 0.894_722_4, 0.003_554_5], [0.025_053_5, 0.008_534_3, 0.999_649_7]], [0.067_82, 0.023_72, 2.660_51]),
        ("2030-12-31T00:00:00", [[-0.995_018_3, 0.096_457_1, 0.025_193_1], [-0.096_712_8, -0.995_270_4, -0.009_134_0], [0.024_192_9, -0.011_525_0, 0.999_640_9]], [0.064_98, -0.030_11, 2.660_84]),
        ("2032-05-25T15:00:00", [[0.244_740_8, 0.969_458_5, 0.015_879_7], [-0.969_444_5, 0.244_389_4, 0.021_238_9], [0.016_709_4, -0.020_592_5, 0.999_648_3]], [0.044_31, -0.056_32, 2.660_58]),
        ("2035-09-02T02:00:00", [[0.901_927_4, -0.431_887_4, 0.000_477_6], [0.431_723_2, 0.901_613_8, 0.026_602_9], [-0.011_920_1, -0.023_787_7, 0.999_646_0]], [-0.030_91, -0.064_80, 2.660_57]),
        ("2037-02-14T20:00:00", [[-0.776_767_8, 0.629_746_9, -0.007_114_3], [-0.629_401_7, -0.776_638_0, -0.026_210_0], [-0.022_030_9, -0.015_881_4, 0.999_631_1]], [-0.057_93, -0.042_53, 2.661_04]),
        ("2040-12-31T00:00:00", [[0.379_462_7, 0.925_180_3, -0.007_040_5], [-0.924_964_9, 0.379_178_2, -0.025_765_5], [-0.021_168_1, 0.016_289_3, 0.999_643_2]], [-0.056_56, 0.045_17, 2.660_69]),
    ];

    fn at(date: &str) -> Orientation {
        Orientation::at(Tai::parse(date, TimeScale::Utc).unwrap())
    }

    #[test]
    fn axes_and_rates_agree_with_integrated_ones() {
        for (date, axes, rate) in AXES {
            let found = at(date);
            // The angle of a small rotation is at most the root of half the sum of its axes' squared distances.
            let squares: f64 = found.axes.into_iter().zip(axes).map(|(a, b)| norm(sub(a, b)).powi(2)).sum();
            let off_deg = (0.5 * squares).sqrt().to_degrees();
            // What is stated: the most at 5,600 dates from 2020 to 2040 is 0.0047 degrees.
            assert!(off_deg < 0.005, "{date}: {off_deg} degrees");
            let off_rad_s = norm(sub(found.rate_rad_s, scale(1e-6, rate)));
            // What is stated; the most at 2,300 dates is 1.3e-10 rad/s.
            assert!(off_rad_s < 2e-10, "{date}: {off_rad_s} rad/s");
        }
    }

    #[test]
    fn rates_are_those_of_the_axes() {
        let time = Tai::parse("2031-05-06T07:08:09", TimeScale::Utc).unwrap();
        let fixed = SatelliteState { position_m: [3e5, -9e5, 1.4e6], velocity_m_s: [0.0; 3] };
        for axes in [MoonAxes::MeanEarth, MoonAxes::Principal] {
            let place = |s: f64| Orientation::at(time.plus_s(s)).state(axes, fixed);
            let by_differences = scale(5e-4, sub(place(1e3).position_m, place(-1e3).position_m));
            // Central differences err by (w h)^2 / 6 = 1e-6 of 4.5 m/s, and roundings of 1e-6 m over 2000 s.
            assert!(norm(sub(place(0.0).velocity_m_s, by_differences)) < 1e-5);
        }
    }

    #[test]
    fn principal_axes_differ_by_the_published_turns() {
        // NAIF's toolkit: `pxform("MOON_PA_DE421", "MOON_ME_DE421", 0) @ [1, 2, 3]`; DE421 places them some 870 m apart.
        let expected = [1.000_483_911, 2.000_324_814, 2.999_622_073];
        assert!(norm(sub(to_mean([1.0, 2.0, 3.0]), expected)) < 2e-9);
    }

    #[test]
    fn names_of_axes() {
        let of = MoonAxes::from_name;
        for name in ["MOON_ME", "MOON_ME_DE421", "MOON_ME_DE440_ME421", "IAU_MOON"] {
            assert_eq!(of(name), Some(MoonAxes::MeanEarth), "{name}");
        }
        for name in ["MOON_PA", "MOON_PA421", "MOON_PA_DE440"] {
            assert_eq!(of(name), Some(MoonAxes::Principal), "{name}");
        }
        // MOON_MEIAUE is the mean equator of a date, which does not turn with the Moon.
        for name in ["MOON_MEIAUE", "MOON_MOD", "ME", "MOON_PAX"] {
            assert_eq!(of(name), None, "{name}");
        }
    }
}
