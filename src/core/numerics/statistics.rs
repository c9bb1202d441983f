//! Order statistics.

/// A standard deviation of normal numbers, in medians of their moduli.
pub(crate) const SIGMA_OF_MEDIAN: f64 = 1.4826;

/// The median (the upper one of an even number of values); `None` without values.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Two percentiles, interpolated linearly between neighbours; `None` without values.
pub fn percentiles(mut values: Vec<f64>, low: f64, high: f64) -> Option<(f64, f64)> {
    if values.is_empty() {
        return None;
    }
    values.sort_unstable_by(f64::total_cmp);
    let at = |percent: f64| {
        let position = percent / 100.0 * (values.len() - 1) as f64;
        let before = position.floor() as usize;
        let after = (before + 1).min(values.len() - 1);
        values[before] + (position - before as f64) * (values[after] - values[before])
    };
    Some((at(low), at(high)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn order_statistics_of_short_lists() {
        assert_eq!(median(vec![]), None);
        assert_eq!(median(vec![3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(vec![4.0, 1.0, 2.0, 3.0]), Some(3.0));
        assert_eq!(percentiles(vec![], 0.0, 100.0), None);
        assert_eq!(percentiles(vec![5.0, 1.0, 3.0], 0.0, 75.0), Some((1.0, 4.0)));
    }
}
