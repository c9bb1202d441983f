use super::*;
use crate::sky::healpix::pixel_directions;

/// Published statistics of ULSA (see the module): MHz; mean, 5, 50, 95 %; b > 60, b < -60, |b| < 5 deg; K.
const ULSA: [(f64, [f64; 4], [f64; 3]); 3] = [
    (1.0, [3.47e7, 0.96e7, 2.69e7, 7.36e7], [6.76e7, 2.67e7, 2.13e7]),
    (3.0, [6.08e6, 3.67e6, 5.81e6, 9.40e6], [6.84e6, 4.67e6, 3.95e6]),
    (10.0, [3.77e5, 2.26e5, 3.20e5, 7.51e5], [3.07e5, 2.40e5, 5.09e5]),
];

fn sky(frequency_mhz: f64, nside: usize, seed: u64) -> Vec<f64> {
    generate(&GeneratedSky::default(), frequency_mhz * 1e6, nside, seed).unwrap()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn points(map: &[f64]) -> [f64; 4] {
    let mut sorted = map.to_vec();
    sorted.sort_by(f64::total_cmp);
    let at = |percent: usize| sorted[(sorted.len() - 1) * percent / 100];
    [mean(map), at(5), at(50), at(95)]
}

/// Means over b > 60, b < -60 and |b| < 5 degrees.
fn zones(map: &[f64], nside: usize) -> [f64; 3] {
    let to_galactic = Frame::Ecliptic.to_frame(Frame::Galactic);
    let latitudes: Vec<f64> = pixel_directions(nside)
        .iter()
        .map(|&d| rotate(&to_galactic, d)[2].clamp(-1.0, 1.0).asin().to_degrees())
        .collect();
    let zone = |inside: &dyn Fn(f64) -> bool| {
        let values: Vec<f64> =
            map.iter().zip(&latitudes).filter(|(_, b)| inside(**b)).map(|(t, _)| *t).collect();
        mean(&values)
    };
    [zone(&|b| b > 60.0), zone(&|b| b < -60.0), zone(&|b| b.abs() < 5.0)]
}

#[test]
fn statistics_are_those_published_for_ulsa() {
    for seed in [0, 1, 2] {
        for (mhz, want, want_zones) in ULSA {
            let map = sky(mhz, 64, seed);
            let found = points(&map);
            let zones = zones(&map, 64);
            for (found, want) in found.into_iter().zip(want) {
                // The requirement of the project.
                assert!((found / want - 1.0).abs() < 0.25, "{mhz} MHz: {found:e} K, published {want:e} K");
            }
            for (found, want) in zones.into_iter().zip(want_zones) {
                // A smooth model cannot reproduce every region of the real sky: within half an e-folding.
                assert!((found / want).ln().abs() < 0.4, "{mhz} MHz: {found:e} K, published {want:e} K");
            }
        }
    }
}

#[test]
fn the_mean_follows_cane_where_ulsa_ends() {
    for mhz in [0.3_f64, 30.0] {
        // Cane (1979), W m^-2 Hz^-1 sr^-1, then T = I c^2 / (2 k nu^2).
        let depth = 5.0 * mhz.powf(-2.1);
        let brightness = 2.48e-20 * mhz.powf(-0.52) * -(-depth).exp_m1() / depth
            + 1.06e-20 * mhz.powf(-0.80) * (-depth).exp();
        let cane = brightness * (2.997_924_58e8 / (mhz * 1e6)).powi(2) / (2.0 * 1.380_649e-23);
        let found = mean(&sky(mhz, 64, 0));
        assert!((0.5..2.0).contains(&(found / cane)), "{mhz} MHz: {found:e} K, Cane {cane:e} K");
    }
}

#[test]
fn never_negative_at_any_frequency() {
    for mhz in [0.1, 0.3, 1.0, 3.0, 10.0, 30.0] {
        assert!(sky(mhz, 64, 5).iter().all(|t| t.is_finite() && *t > 0.0), "{mhz} MHz");
    }
    let wild = GeneratedSky {
        small_scale_amplitude: 10.0,
        cloud_log_rms: 1.0,
        index_rms: 0.3,
        source_flux_jy_min: 0.1,
        ..GeneratedSky::default()
    };
    assert_eq!(wild.problems(), []);
    assert!(generate(&wild, 1e5, 64, 0).unwrap().iter().all(|t| t.is_finite() && *t > 0.0));
}

#[test]
fn seeds_make_skies() {
    assert_eq!(sky(3.0, 64, 7), sky(3.0, 64, 7));
    let (a, b) = (sky(3.0, 64, 7), sky(3.0, 64, 8));
    let different = a.iter().zip(&b).filter(|(a, b)| (*a / *b - 1.0).abs() > 1e-3).count();
    assert!(different > a.len() / 2);
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        assert_eq!(pool.install(|| sky(3.0, 64, 7)), a, "{threads} threads");
    }
}

#[test]
fn one_sky_at_every_nside() {
    let smooth = GeneratedSky { point_sources: false, ..GeneratedSky::default() };
    let fine = generate(&smooth, 10e6, 128, 1).unwrap();
    let coarse = generate(&smooth, 10e6, 64, 1).unwrap();
    let other = generate(&smooth, 10e6, 64, 2).unwrap();
    let degraded = averaged(&fine, 128, 64);
    let rms = |map: &[f64]| {
        let squares: Vec<f64> = degraded.iter().zip(map).map(|(a, b)| (b / a - 1.0).powi(2)).collect();
        mean(&squares).sqrt()
    };
    // Pixels differ in their averages at edges of nebulae; another seed would differ by the fluctuations.
    assert!(rms(&coarse) < 0.02, "{}", rms(&coarse));
    assert!(rms(&other) > 2.0 * rms(&coarse), "{} {}", rms(&other), rms(&coarse));
    // Below nside 64 maps are averages.
    assert_eq!(generate(&smooth, 10e6, 16, 1).unwrap(), averaged(&coarse, 64, 16));
}

#[test]
fn sources_carry_their_flux_at_every_nside() {
    let with = GeneratedSky { sources_absorbed: false, ..GeneratedSky::default() };
    let without = GeneratedSky { point_sources: false, ..with.clone() };
    let sum = |nside: usize| {
        let (a, b) = (generate(&with, 30e6, nside, 4).unwrap(), generate(&without, 30e6, nside, 4).unwrap());
        // The background subtracted for the sources is the same in both; compare the excess.
        a.iter().zip(&b).map(|(a, b)| a - b).sum::<f64>() * pixel_area_sr(nside)
    };
    let (one, two) = (sum(32), sum(128));
    // Excess of all sources over their mean, within one per cent of their total flux.
    let all: f64 = sources::draw(&with, 4).iter().map(|s| s.flux_jy).sum::<f64>()
        * sources::kelvin_sr_per_jansky(&with, 30e6);
    assert!((one - two).abs() < 0.01 * all, "{one} {two} {all}");
}

#[test]
fn small_scales_have_the_slope_of_the_formula() {
    let power = fluctuations::small_scale_power(191, 5f64.to_radians());
    let slope = (power[180] / power[120]).ln() / (180.0_f64 / 120.0).ln();
    assert!((slope + 2.703).abs() < 0.01, "{slope}");
    // The variance of one realisation scatters about the sum over its power spectrum by a few per cent.
    let field = gaussian_field(&power, 64, 11, RandomField::SmallScales).unwrap();
    let variance = mean(&field.iter().map(|v| v * v).collect::<Vec<_>>());
    let expected = power.iter().enumerate().map(|(l, c)| (2 * l + 1) as f64 * c).sum::<f64>()
        / (4.0 * std::f64::consts::PI);
    assert!((variance / expected - 1.0).abs() < 0.3, "{variance} {expected}");
}

#[test]
fn wrong_requests_are_named() {
    let config = GeneratedSky::default();
    for hz in [0.0, 9e4, 121e6, f64::NAN, f64::INFINITY] {
        assert!(matches!(generate(&config, hz, 8, 0), Err(GeneratedSkyError::Frequency { .. })));
    }
    for nside in [0, 3, 2048, usize::MAX] {
        assert_eq!(generate(&config, 1e7, nside, 0), Err(GeneratedSkyError::Nside { nside }));
    }
    let wrong = GeneratedSky {
        index_rms: f64::NAN,
        source_flux_jy_min: 75.0,
        small_scale_l_max: 0,
        ..GeneratedSky::default()
    };
    assert_eq!(wrong.problems().len(), 3);
    assert!(generate(&wrong, 1e7, 8, 0).is_err());
}
