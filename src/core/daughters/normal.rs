//! Complex normal deviates in bulk.

use multiversion::multiversion;
use rand::Rng;

use crate::units::arithmetic::{cos_sin_turns, fused, polynomial};

/// Number of deviates of a chunk.
pub(super) const CHUNK: usize = 64;

/// Random bytes for a chunk.
pub(super) type Bytes = [[u8; 4]; 2 * CHUNK];

/// Fills `re` and `im` (of equal numbers of chunks) with complex normal deviates of variance one: 1/2 in each part.
///
/// Box-Muller transform in `f32`: |z| is at most sqrt(33 ln 2) = 4.8, which an exact deviate exceeds once in 1e10;
/// relative errors are below 1e-5.
pub(super) fn fill_complex_normal(rng: &mut impl Rng, bytes: &mut Bytes, re: &mut [f32], im: &mut [f32]) {
    let chunks = re.as_chunks_mut::<CHUNK>().0.iter_mut().zip(im.as_chunks_mut::<CHUNK>().0);
    for (re, im) in chunks {
        rng.fill_bytes(bytes.as_flattened_mut());
        transform(bytes, re, im);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn transform(words: &Bytes, x: &mut [f32; CHUNK], y: &mut [f32; CHUNK]) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    for k in 0..CHUNK {
        // Odd multiples of 2^-33: never 0.
        let uniform =
            (u32::from_le_bytes(words[k]) >> 1) as i32 as f32 * 2.0_f32.powi(-31) + 2.0_f32.powi(-33);
        let radius = minus_ln::<FMA>(uniform).max(0.0).sqrt();
        let turns = i32::from_le_bytes(words[CHUNK + k]) as f32 * 2.0_f32.powi(-32);
        let (cos, sin) = cos_sin_turns::<FMA>(turns);
        x[k] = radius * cos;
        y[k] = radius * sin;
    }
}

/// -ln(u) for 0 < u <= 1, to 1e-6 of max(1, value).
///
/// u = 2^e m with m in [sqrt(1/2), sqrt(2)); ln m by the series of atanh((m - 1) / (m + 1)), |.| < 0.172,
/// whose first omitted term is below 2e-9.
#[inline(always)]
fn minus_ln<const FMA: bool>(u: f32) -> f32 {
    const SERIES: [f32; 5] = [2.0, 2.0 / 3.0, 2.0 / 5.0, 2.0 / 7.0, 2.0 / 9.0];
    let bits = u.to_bits().wrapping_sub(0x3f35_04f3);
    let exponent = (bits.cast_signed() >> 23) as f32;
    let m = f32::from_bits((bits & 0x007f_ffff).wrapping_add(0x3f35_04f3));
    let s = (m - 1.0) / (m + 1.0);
    let ln_m = s * polynomial::<FMA, 5>(&SERIES, s * s);
    fused::<FMA>(-exponent, std::f32::consts::LN_2, -ln_m)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::{StreamKind, random_stream};

    #[test]
    fn the_logarithm_is_right() {
        for k in 1..100_000_u32 {
            let u = k as f32 / 100_000.0;
            let expected = -f64::from(u).ln();
            // As documented.
            assert!((f64::from(minus_ln::<false>(u)) - expected).abs() < 1e-6 * expected.max(1.0), "{u}");
        }
        let least = 2.0_f32.powi(-33);
        assert!((minus_ln::<false>(least) - 33.0 * std::f32::consts::LN_2).abs() < 1e-5);
    }

    /// The error function by its series (Abramowitz & Stegun 7.1.6), whose terms are all positive.
    fn erf(x: f64) -> f64 {
        let (mut term, mut sum) = (x, x);
        for n in 1..200 {
            term *= 2.0 * x * x / f64::from(2 * n + 1);
            sum += term;
        }
        sum * std::f64::consts::FRAC_2_SQRT_PI * (-x * x).exp()
    }

    #[test]
    fn the_error_function_is_that_of_the_tables() {
        // Abramowitz & Stegun, Table 7.1.
        for (x, expected) in
            [(0.1, 0.112_462_916_0), (0.5, 0.520_499_877_8), (1.0, 0.842_700_792_9), (2.0, 0.995_322_265_0)]
        {
            assert!((erf(x) - expected).abs() < 1e-10 && (erf(-x) + expected).abs() < 1e-10, "{x}");
        }
    }

    #[test]
    fn deviates_have_the_distribution_of_a_normal_variable() {
        const COUNT: usize = 1 << 21;
        let (mut re, mut im) = (vec![0.0; COUNT], vec![0.0; COUNT]);
        let mut rng = random_stream(5, StreamKind::Samples, [0, 0]);
        fill_complex_normal(&mut rng, &mut [[0; 4]; 2 * CHUNK], &mut re, &mut im);
        for part in [&mut re, &mut im] {
            part.sort_unstable_by(f32::total_cmp);
            let n = COUNT as f64;
            let mut distance = 0.0_f64;
            for (k, &x) in part.iter().enumerate() {
                // Of variance 1/2.
                let expected = 0.5 * (1.0 + erf(f64::from(x)));
                distance =
                    distance.max((k as f64 / n - expected).abs()).max(((k + 1) as f64 / n - expected).abs());
            }
            // Kolmogorov: beyond 1.95 / sqrt(n) once in a thousand.
            assert!(distance * n.sqrt() < 1.95, "{distance}");
        }
    }

    #[test]
    fn tails_are_gaussian_to_five_deviations() {
        const COUNT: usize = 1 << 20;
        const ROUNDS: usize = 64;
        // Two-sided probability beyond k standard deviations: 1 - erf(k / sqrt 2), as tabulated.
        const TAILS: [(f32, f64); 4] =
            [(3.0, 2.699_796e-3), (4.0, 6.334_248e-5), (4.5, 6.795_346e-6), (5.0, 5.733_031e-7)];
        let (mut re, mut im) = (vec![0.0; COUNT], vec![0.0; COUNT]);
        let mut rng = random_stream(6, StreamKind::Samples, [0, 0]);
        // By part and sign.
        let mut beyond = [[0_u32; 4]; TAILS.len()];
        for _ in 0..ROUNDS {
            fill_complex_normal(&mut rng, &mut [[0; 4]; 2 * CHUNK], &mut re, &mut im);
            for (part, values) in [&re, &im].into_iter().enumerate() {
                for &x in values.iter().filter(|x| x.abs() > 3.0 * std::f32::consts::FRAC_1_SQRT_2) {
                    for (counts, (deviations, _)) in beyond.iter_mut().zip(TAILS) {
                        let far = x.abs() > deviations * std::f32::consts::FRAC_1_SQRT_2;
                        counts[2 * part + usize::from(x < 0.0)] += u32::from(far);
                    }
                }
            }
        }
        for (counts, (deviations, probability)) in beyond.into_iter().zip(TAILS) {
            let expected = 0.5 * probability * (COUNT * ROUNDS) as f64;
            for count in counts {
                // Poisson: four standard errors, of 19 at five deviations.
                assert!(
                    (f64::from(count) - expected).abs() < 4.0 * expected.sqrt(),
                    "{deviations}: {counts:?}"
                );
            }
        }
    }

    #[test]
    fn moments_are_those_of_a_complex_normal() {
        const COUNT: usize = 1 << 20;
        let (mut re, mut im) = (vec![0.0; COUNT], vec![0.0; COUNT]);
        let mut rng = random_stream(1, StreamKind::Samples, [0, 0]);
        fill_complex_normal(&mut rng, &mut [[0; 4]; 2 * CHUNK], &mut re, &mut im);
        let mean = |f: &dyn Fn(f64, f64) -> f64| {
            re.iter().zip(&im).map(|(&x, &y)| f(x.into(), y.into())).sum::<f64>() / COUNT as f64
        };
        let n = COUNT as f64;
        // Expected value and variance of a sample, x and y normal of variance 1/2.
        for (found, expected, variance) in [
            (mean(&|x, _| x), 0.0, 0.5),
            (mean(&|_, y| y), 0.0, 0.5),
            (mean(&|x, y| x * y), 0.0, 0.25),
            (mean(&|x, _| x * x), 0.5, 0.5),
            (mean(&|_, y| y * y), 0.5, 0.5),
            (mean(&|x, _| x.powi(4)), 0.75, 105.0 / 16.0 - 0.75 * 0.75),
            (mean(&|x, y| f64::from(x * x + y * y > 9.0)), (-9.0_f64).exp(), (-9.0_f64).exp()),
        ] {
            // Five standard errors.
            assert!((found - expected).abs() < 5.0 * (variance / n).sqrt(), "{found} {expected}");
        }
    }
}
