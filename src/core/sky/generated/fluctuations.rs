//! Gaussian random fields on the sphere, the same at every nside.

use rand::RngExt;
use rand_distr::StandardNormal;

use crate::sky::harmonics::{Alm, HarmonicsError, synthesis};
use crate::units::{StreamKind, random_stream};

/// Slope of the power of small scales (Remazeilles et al. 2015, Eq. 23 ff.).
const SMALL_SCALE_SLOPE: f64 = -2.703;
/// Amplitude of small scales at 408 MHz in K (Remazeilles et al. 2015).
const SMALL_SCALE_ALPHA: f64 = 0.0599;

/// Exponent of small scales (Remazeilles et al. 2015).
const SMALL_SCALE_BETA: f64 = 0.782;

/// Resolution of the 408 MHz map, FWHM 56', beyond which the field of Remazeilles et al. has unit variance.
const HASLAM_FWHM_RAD: f64 = 56.0 / 60.0 * std::f64::consts::PI / 180.0;

/// Maximum degree of that variance: that of nside 1024.
const NORMALISED_TO: usize = 3071;

/// Slope of the large-scale fields: clouds of the absorber, and variations of the index.
const LARGE_SCALE_SLOPE: f64 = -2.7;

/// Range of degrees of the large-scale fields.
const LARGE_SCALE_DEGREES: std::ops::RangeInclusive<usize> = 4..=383;

/// Random fields, each with its own random stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RandomField {
    /// Field G of Remazeilles et al.
    SmallScales = 0,
    /// Logarithm of the opacity of the warm gas.
    Clouds = 1,
    /// Temperature index of the synchrotron emission.
    Index = 2,
}

/// Fractional small-scale fluctuation for a value `g` of the field and an emission of `kelvin_408`
/// at 408 MHz: T_ss / T = alpha G T^(beta - 1).
pub(super) fn small_scale_fraction(g: f64, kelvin_408: f64) -> f64 {
    SMALL_SCALE_ALPHA * g * kelvin_408.powf(SMALL_SCALE_BETA - 1.0)
}

/// Power spectrum C_l, l = 0..=`l_max`, of G: l^gamma (1 - exp(-l^2 sigma^2)) with the sigma of `fwhm_rad`,
/// the resolution of the template.
///
/// The scale is that of the paper, unit variance beyond 56', for any `fwhm_rad`: a coarser template
/// gets the same small scales plus the intermediate ones that it lacks.
pub(super) fn small_scale_power(l_max: usize, fwhm_rad: f64) -> Vec<f64> {
    let shape = |l: usize, fwhm_rad: f64| {
        let l = l as f64;
        let sigma = fwhm_rad / (8.0 * 2.0_f64.ln()).sqrt();
        if l < 1.0 { 0.0 } else { l.powf(SMALL_SCALE_SLOPE) * -(-(l * sigma).powi(2)).exp_m1() }
    };
    let scale = 1.0 / variance((0..=NORMALISED_TO).map(|l| shape(l, HASLAM_FWHM_RAD)));
    (0..=l_max).map(|l| scale * shape(l, fwhm_rad)).collect()
}

/// Power spectrum C_l, l = 0..=`l_max`, of the large-scale fields, with unit variance over all their degrees.
pub(super) fn large_scale_power(l_max: usize) -> Vec<f64> {
    let shape =
        |l: usize| if LARGE_SCALE_DEGREES.contains(&l) { (l as f64).powf(LARGE_SCALE_SLOPE) } else { 0.0 };
    let scale = 1.0 / variance((0..=*LARGE_SCALE_DEGREES.end()).map(shape));
    (0..=l_max.min(*LARGE_SCALE_DEGREES.end())).map(|l| scale * shape(l)).collect()
}

/// Variance of a field with power spectrum C_l, l = 0, 1, ...
fn variance(power: impl Iterator<Item = f64>) -> f64 {
    power.enumerate().map(|(l, c)| (2 * l + 1) as f64 * c).sum::<f64>() / (4.0 * std::f64::consts::PI)
}

/// Draws a Gaussian field with power spectrum C_l = `power[l]`, in RING order.
///
/// Coefficients are drawn in the order of l, then m, so that a longer `power` only adds degrees.
///
/// # Errors
/// As [`synthesis`].
pub(super) fn gaussian_field(
    power: &[f64],
    nside: usize,
    seed: u64,
    field: RandomField,
) -> Result<Vec<f64>, HarmonicsError> {
    let mut stream = random_stream(seed, StreamKind::SkyFluctuations, [field as u64, 0]);
    let mut alm = Alm::zeros(power.len().saturating_sub(1));
    for (l, c) in power.iter().enumerate() {
        let amplitude = c.sqrt();
        alm.get_mut(l, 0).re = amplitude * stream.sample::<f64, _>(StandardNormal);
        for m in 1..=l {
            let value = alm.get_mut(l, m);
            value.re = amplitude * std::f64::consts::FRAC_1_SQRT_2 * stream.sample::<f64, _>(StandardNormal);
            value.im = amplitude * std::f64::consts::FRAC_1_SQRT_2 * stream.sample::<f64, _>(StandardNormal);
        }
    }
    synthesis(&alm, nside)
}
