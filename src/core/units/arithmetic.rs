//! Branch-free arithmetic for inner loops that the compiler vectorises.
//!
//! A kernel that `multiversion` compiles for several targets sets `FMA` where the hardware has fused multiply-adds;
//! elsewhere each would be a call into the C library.

/// Computes `a b + c` in f32, fused if `FMA`.
#[inline(always)]
pub(crate) fn fused<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// Computes `a b + c` in f64, fused if `FMA`.
#[inline(always)]
pub(crate) fn fused64<const FMA: bool>(a: f64, b: f64, c: f64) -> f64 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// The difference between `turns` and the nearest whole number, exact for |turns| < 2^51.
///
/// Rounds by adding 1.5 2^52, which leaves no bits for a fraction, so that no target needs a library call.
#[inline(always)]
pub(crate) fn fraction_of_turn(turns: f64) -> f32 {
    const MAGIC: f64 = 6_755_399_441_055_744.0;
    (turns - ((turns + MAGIC) - MAGIC)) as f32
}

/// Evaluates a polynomial by Horner's rule; the constant term is the first coefficient.
#[inline(always)]
pub(crate) fn polynomial<const FMA: bool, const N: usize>(coefficients: &[f32; N], x: f32) -> f32 {
    let mut sum = coefficients[N - 1];
    for k in (0..N - 1).rev() {
        sum = fused::<FMA>(sum, x, coefficients[k]);
    }
    sum
}

/// The cosine and sine of 2 pi `turns`, |turns| <= 1/2, to 1e-6.
///
/// Polynomials in t^2 give sin(pi t)/t and cos(pi t) (interpolated at the Chebyshev points of 0 <= t^2 <= 1/4); double-angle formulas follow.
#[inline(always)]
pub(crate) fn cos_sin_turns<const FMA: bool>(turns: f32) -> (f32, f32) {
    const SIN: [f32; 5] = [std::f32::consts::PI, -5.167_710_3, 2.550_077_4, -0.598_291_3, 0.077_657_66];
    const COS: [f32; 6] = [1.0, -4.934_802, 4.058_709, -1.335_212, 0.234_937_2, -0.024_396_325];
    let square = turns * turns;
    let sin = turns * polynomial::<FMA, 5>(&SIN, square);
    let cos = polynomial::<FMA, 6>(&COS, square);
    let twice = sin + sin;
    (fused::<FMA>(-twice, sin, 1.0), twice * cos)
}

/// e^x - 1 and e^x for x <= 700, each to a few 1e-16 of it; below -700 those of -700.
///
/// x = k ln 2 + r, |r| <= ln 2 / 2, and the series of e^r - 1, whose first omitted term is below 1e-17 of it.
#[inline(always)]
pub(crate) fn exponentials<const FMA: bool>(x: f64) -> (f64, f64) {
    /// Adding 1.5 2^52 rounds to a whole number, which is then in the low bits.
    const MAGIC: f64 = 6_755_399_441_055_744.0;
    /// 13!, 12!, .. 2!
    const FACTORIALS: [f64; 12] = [
        6_227_020_800.0,
        479_001_600.0,
        39_916_800.0,
        3_628_800.0,
        362_880.0,
        40_320.0,
        5_040.0,
        720.0,
        120.0,
        24.0,
        6.0,
        2.0,
    ];
    let x = x.max(-700.0);
    let shifted = fused64::<FMA>(x, std::f64::consts::LOG2_E, MAGIC);
    let k = shifted - MAGIC;
    // ln 2 in two parts, the first of so few bits that its product with k is exact (fdlibm).
    let r = fused64::<FMA>(k, -6.931_471_803_691_238e-1, x);
    let r = fused64::<FMA>(k, -1.908_214_929_270_587_7e-10, r);
    let mut sum = 0.0;
    for factorial in FACTORIALS {
        sum = fused64::<FMA>(sum, r, 1.0 / factorial);
    }
    let less_one = fused64::<FMA>(r * r, sum, r);
    let power = f64::from_bits(shifted.to_bits().wrapping_add(1023) << 52);
    (fused64::<FMA>(power, less_one, power - 1.0), fused64::<FMA>(power, less_one, power))
}

/// The function sin(x) / x, 1 at x = 0.
#[inline]
pub(crate) fn sinc(x: f64) -> f64 {
    if x.abs() < 1e-8 { 1.0 } else { x.sin() / x }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn sines_of_turns_agree_with_the_library() {
        for k in -5000..=5000 {
            let turns = k as f32 / 1e4;
            let (cos, sin) = cos_sin_turns::<false>(turns);
            let angle = TAU * f64::from(turns);
            // The documented accuracy of the polynomials in f32.
            assert!((f64::from(cos) - angle.cos()).abs() < 1e-6, "{turns}");
            assert!((f64::from(sin) - angle.sin()).abs() < 1e-6, "{turns}");
        }
    }

    #[test]
    fn fractions_of_many_turns_keep_their_bits() {
        // 100 km at 30 MHz is 1e4 turns.
        for turns in [0.0, 0.25, -0.25, 10_006.922_9, -10_006.499_9, 1e9 + 0.125] {
            let expected = turns - f64::round(turns);
            assert!((f64::from(fraction_of_turn(turns)) - expected).abs() < 1e-7, "{turns}");
        }
    }

    #[test]
    fn exponentials_agree_with_the_library() {
        let sizes = (0..1800).map(|k| 1e-12 * 1.02_f64.powi(k)).take_while(|&x| x < 700.0);
        for x in sizes.flat_map(|x| [-x, x]).chain([0.0, 0.5 * std::f64::consts::LN_2]) {
            for (less_one, whole) in [exponentials::<false>(x), exponentials::<true>(x)] {
                // A few roundings of 1.1e-16 of terms that are at most twice the result.
                let close = |found: f64, expected: f64| (found - expected).abs() <= 8e-16 * expected;
                assert!(
                    close(less_one.abs(), x.exp_m1().abs()) && close(whole, x.exp()),
                    "{x:e}: {less_one:e} {whole:e}"
                );
                assert_eq!(less_one.signum() * x.signum(), 1.0);
            }
        }
        assert_eq!(exponentials::<false>(-1e9).0, -1.0);
    }
}
