//! Sine and cosine for vectorised loops.

/// Sine and cosine of `v`, |v| < 1e6, to about 1e-16 (and 1e-16 |v| from the argument itself).
///
/// Reduction by quarter turns in three parts, then the Cephes polynomials (Moshier) on |r| <= pi/4.
/// Without branches, so that loops over it become vector code.
#[inline(always)]
pub(crate) fn sin_cos(v: f64) -> (f64, f64) {
    /// Adding 1.5 * 2^52 rounds to a whole number, which is then in the low bits.
    const ROUND: f64 = 6_755_399_441_055_744.0;
    let shifted = v * std::f64::consts::FRAC_2_PI + ROUND;
    let quarter = shifted.to_bits();
    let turns = shifted - ROUND;
    let r = v - turns * 1.570_796_251_296_997;
    let r = r - turns * 7.549_789_415_861_596e-8;
    let r = r - turns * 5.390_302_858_158_119e-15;
    let z = r * r;
    let sin = 1.589_623_015_765_465_7e-10;
    let sin = sin * z - 2.505_074_776_285_780_7e-8;
    let sin = sin * z + 2.755_731_362_138_572_5e-6;
    let sin = sin * z - 1.984_126_982_958_954e-4;
    let sin = sin * z + 8.333_333_333_322_119e-3;
    let sin = sin * z - 1.666_666_666_666_663e-1;
    let sin = r + r * z * sin;
    let cos = -1.135_853_652_138_768_2e-11;
    let cos = cos * z + 2.087_570_084_197_473e-9;
    let cos = cos * z - 2.755_731_417_929_674e-7;
    let cos = cos * z + 2.480_158_728_885_170_5e-5;
    let cos = cos * z - 1.388_888_888_887_305_6e-3;
    let cos = cos * z + 4.166_666_666_666_659e-2;
    let cos = 1.0 - 0.5 * z + z * z * cos;
    let odd = quarter & 1 == 1;
    let (s, c) = if odd { (cos, sin) } else { (sin, cos) };
    let flip = |x: f64, bit: u64| f64::from_bits(x.to_bits() ^ (bit << 63));
    (flip(s, (quarter >> 1) & 1), flip(c, ((quarter >> 1) ^ quarter) & 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agrees_with_the_standard_library() {
        for k in -20_000..20_000 {
            let v = 0.0731 * f64::from(k);
            let (s, c) = sin_cos(v);
            // Two different reductions of phases of up to 1500 rad.
            assert!((s - v.sin()).abs() < 4e-16 && (c - v.cos()).abs() < 4e-16, "{v}");
        }
    }
}
