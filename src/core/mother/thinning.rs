//! Subsampling of observing windows and integrations, to simulate a fraction of a mission's visibilities.

/// Selection of the windows that are observed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WindowThinning {
    /// Every n-th window. Aliases with any period that nearly divides the duration of n windows.
    EveryNth(u64),
    /// One window of each block of n, at a pseudo-random position derived from the block's number, so that it aliases
    /// with no period.
    Spread(u64),
}

impl WindowThinning {
    /// Whether the window with this number is observed.
    #[must_use]
    pub fn keeps(self, window: u64) -> bool {
        match self {
            Self::EveryNth(n) => window.is_multiple_of(n.max(1)),
            Self::Spread(n) => window % n.max(1) == hash_below(window / n.max(1), n),
        }
    }

    /// Index of the first integration kept in a window, when every `every_nth`-th is kept. It changes from window to
    /// window, so that no part of a window is always left out.
    #[must_use]
    pub fn first_integration(self, window: u64, every_nth: u64) -> u64 {
        match self {
            Self::EveryNth(n) => window / n.max(1),
            // The complement makes this choice independent of that of the window.
            Self::Spread(n) => hash_below(!(window / n.max(1)), every_nth),
        }
    }
}

/// Pseudo-random number below `bound`, by the mixing function of SplitMix64 (Steele et al. 2014). Maps 0 to 0, so
/// that a mission always has its first window.
fn hash_below(number: u64, bound: u64) -> u64 {
    let mixed = (number ^ (number >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((u128::from(mixed ^ (mixed >> 31)) * u128::from(bound)) >> 64) as u64
}

/// Strides of windows and of integrations that together keep one visibility in `thin`. Many windows with few
/// integrations each cover the orbital, monthly and precession periods better than few complete windows.
#[must_use]
pub fn strides(thin: u64) -> (u64, u64) {
    let windows = thin.max(1).isqrt();
    (windows, (thin.max(1) + windows / 2) / windows)
}

/// Largest fraction of a period that contains none of these times, 0 to 1.
#[must_use]
pub fn largest_gap(times_s: impl Iterator<Item = f64>, period_s: f64) -> f64 {
    let mut phases: Vec<f64> = times_s.map(|t_s| (t_s / period_s).rem_euclid(1.0)).collect();
    phases.sort_by(f64::total_cmp);
    let (Some(first), Some(last)) = (phases.first(), phases.last()) else { return 1.0 };
    phases.windows(2).map(|pair| pair[1] - pair[0]).fold(1.0 + first - last, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig, ObservingWindows};
    use crate::units::constants::SIDEREAL_MONTH_S;

    #[test]
    fn one_window_of_each_block_of_n_is_kept() {
        for n in [1, 2, 7, 17, 24, 300] {
            for block in 0..500 {
                let kept =
                    (block * n..(block + 1) * n).filter(|&k| WindowThinning::Spread(n).keeps(k)).count();
                assert_eq!(kept, 1, "{n}, from window {}", block * n);
            }
        }
        // A mission shorter than n windows has its first window, as with every n-th.
        assert!(WindowThinning::Spread(300).keeps(0));
    }

    #[test]
    fn one_visibility_in_n_is_kept() {
        assert_eq!([1, 2, 3, 4, 300, 600].map(strides), [(1, 1), (1, 2), (1, 3), (2, 2), (17, 18), (24, 25)]);
        for thin in 1..2000_u64 {
            let (windows, integrations) = strides(thin);
            // Rounding to whole integrations can cost half a stride of windows.
            assert!((windows * integrations).abs_diff(thin) <= windows.div_ceil(2), "{thin}");
        }
    }

    /// Number of kept windows of 1.3 years of the paper's array in cells of equal size over two periods: minimum,
    /// mean and maximum.
    fn coverage(windows: WindowThinning, periods_s: [f64; 2]) -> [f64; 3] {
        const SIDE: usize = 5;
        let config = ArrayConfig::default();
        let array = Array::new(&config).unwrap();
        let mut counts = [0.0; SIDE * SIDE];
        let all = ObservingWindows::new(&array, 0.0, config.precession_period_s);
        for window in all.filter(|window| windows.keeps(window.index)) {
            let [row, column] =
                periods_s.map(|s| ((window.start.seconds() / s).fract() * SIDE as f64) as usize);
            counts[row * SIDE + column] += 1.0;
        }
        let mean = counts.iter().sum::<f64>() / counts.len() as f64;
        [
            counts.iter().copied().fold(f64::INFINITY, f64::min),
            mean,
            counts.iter().copied().fold(0.0, f64::max),
        ]
    }

    #[test]
    fn spread_windows_cover_month_breathing_and_precession_together() {
        let config = ArrayConfig::default();
        let (breathing_s, precession_s) = (config.breathing.period_s, config.precession_period_s);
        // The third period is arbitrary.
        for other_s in [SIDEREAL_MONTH_S, breathing_s, 9.3 * 86_400.0] {
            for thin in [150, 300, 600] {
                let spread = WindowThinning::Spread(strides(thin).0);
                let [least, mean, most] = coverage(spread, [precession_s, other_s]);
                // 2.5 times the Poisson scatter; stratification only reduces it.
                let bar = 2.5 * mean.sqrt();
                assert!(
                    least > mean - bar && most < mean + bar,
                    "{thin}, {other_s} s: {least} {mean} {most}"
                );
            }
        }
        // Every 286th window is always at the same phase of the month: cells stay empty.
        let [least, ..] = coverage(WindowThinning::EveryNth(286), [precession_s, SIDEREAL_MONTH_S]);
        assert!(least < f64::EPSILON, "{least}");
    }

    #[test]
    fn integrations_begin_at_all_positions() {
        let mut counts = [0_u32; 8];
        for window in 0..8_000 {
            counts[WindowThinning::Spread(10).first_integration(10 * window, 8) as usize] += 1;
        }
        // Five Poisson standard deviations of a count of 1000.
        assert!(counts.iter().all(|count| count.abs_diff(1000) < 160), "{counts:?}");
    }

    #[test]
    fn gaps_are_found_around_the_end_of_a_period() {
        assert!((largest_gap([0.2, 0.5, 10.3].into_iter(), 1.0) - 0.7).abs() < 1e-12);
        assert!((largest_gap([0.1, 1.6, 0.9].into_iter(), 1.0) - 0.5).abs() < 1e-12);
        assert!((largest_gap(std::iter::empty(), 1.0) - 1.0).abs() < f64::EPSILON);
    }
}
