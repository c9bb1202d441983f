//! Chooses ticks at round numbers, and their labels.

#[derive(Clone, Debug, PartialEq)]
pub(super) struct Ticks {
    /// Values with a label.
    pub labelled: Vec<(f64, String)>,
    /// Values without a label.
    pub minor: Vec<f64>,
    /// Power of ten that is the unit of the labels.
    pub exponent: i32,
}

impl Ticks {
    /// The unit to print beside the ticks, such as `K` or `10⁵ K`.
    pub fn unit(&self, unit: &str) -> String {
        match (self.exponent, unit.is_empty()) {
            (0, _) => unit.to_owned(),
            (exponent, true) => power_of_ten(exponent),
            (exponent, false) => format!("{} {unit}", power_of_ten(exponent)),
        }
    }
}

/// About `wanted` ticks of a linear scale.
pub(super) fn linear(low: f64, high: f64, wanted: usize) -> Ticks {
    let step = round_step((high - low) / wanted.max(1) as f64);
    let magnitude = low.abs().max(high.abs());
    // Values up to 1.5e6 are labelled in units of 1e5.
    let decade = if magnitude > 0.0 { (magnitude / 1.5).log10().floor() as i32 } else { 0 };
    let exponent = if (-3..5).contains(&decade) { 0 } else { decade };
    let decimals = (exponent - step.log10().floor() as i32).clamp(0, 12) as usize;
    let values = multiples(low, high, step);
    let labelled = values
        .into_iter()
        .map(|value| {
            // Print an exact zero, not the rounding error of a sum of steps.
            let value = if value.abs() < 1e-9 * step { 0.0 } else { value };
            (value, minus(format!("{:.decimals$}", value / 10f64.powi(exponent))))
        })
        .collect();
    Ticks { labelled, minor: multiples(low, high, step / minor_parts(step)), exponent }
}

/// About `wanted` ticks of a logarithmic scale; `low` must be positive.
pub(super) fn logarithmic(low: f64, high: f64, wanted: usize) -> Ticks {
    let (first, last) = (low.log10().floor() as i32, high.log10().ceil() as i32);
    let decades = high.log10() - low.log10();
    let inside = |value: &f64| *value >= low * (1.0 - 1e-9) && *value <= high * (1.0 + 1e-9);
    let every = |digits: &'static [f64]| {
        let value = move |decade: i32| digits.iter().map(move |d| d * 10f64.powi(decade));
        (first..=last).flat_map(value).filter(inside).collect::<Vec<f64>>()
    };
    let minor = if decades < 12.0 { every(&[1., 2., 3., 4., 5., 6., 7., 8., 9.]) } else { Vec::new() };
    if decades > 1.9 {
        let stride = ((decades / wanted.max(1) as f64).ceil() as i32).max(1);
        let labelled = (first..=last)
            .filter(|decade| decade.rem_euclid(stride) == 0)
            .map(|decade| (10f64.powi(decade), power_of_ten(decade)))
            .filter(|(value, _)| inside(value))
            .collect();
        return Ticks { labelled, minor, exponent: 0 };
    }
    let choices: [&'static [f64]; 3] = [&[1., 2., 5.], &[1., 1.5, 2., 3., 4., 5., 7.], &[1., 3.]];
    let few = wanted / 2;
    let candidates = choices.map(every);
    let chosen = if candidates[0].len() > wanted {
        &candidates[2]
    } else if candidates[0].len() <= few {
        &candidates[1]
    } else {
        &candidates[0]
    };
    if chosen.len() < 3 {
        return linear(low, high, wanted);
    }
    let decade = (0.5 * (low.log10() + high.log10())).floor() as i32;
    let exponent = if (-2..3).contains(&decade) { 0 } else { decade };
    let labelled =
        chosen.iter().map(|&value| (value, plain(value / 10f64.powi(exponent)))).collect::<Vec<_>>();
    Ticks { labelled, minor, exponent }
}

pub(super) fn power_of_ten(exponent: i32) -> String {
    const RAISED: [char; 10] = ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'];
    let raise = |c: char| match c.to_digit(10) {
        Some(digit) => RAISED[digit as usize],
        None => '⁻',
    };
    format!("10{}", exponent.to_string().chars().map(raise).collect::<String>())
}

/// Formats a value without trailing zeros.
fn plain(value: f64) -> String {
    let text = format!("{value:.4}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    minus(text.to_owned())
}

fn minus(text: String) -> String {
    text.replace('-', "−")
}

/// The smallest of 1, 2, 5 times a power of ten that is at least `step`.
fn round_step(step: f64) -> f64 {
    if !(step > 0.0 && step.is_finite()) {
        return 1.0;
    }
    let decade = 10f64.powf(step.log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * decade).find(|s| *s >= step * (1.0 - 1e-9)).unwrap_or(step)
}

fn minor_parts(step: f64) -> f64 {
    let lead = step / 10f64.powf(step.log10().floor());
    if (1.5..3.0).contains(&lead) { 4.0 } else { 5.0 }
}

/// Multiples of `step` between `low` and `high`, at most a thousand.
fn multiples(low: f64, high: f64, step: f64) -> Vec<f64> {
    let (first, last) = ((low / step - 1e-6).ceil(), (high / step + 1e-6).floor());
    let count = (last - first + 1.0).clamp(0.0, 1000.0) as usize;
    (0..count).map(|k| (first + k as f64) * step).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(ticks: &Ticks) -> Vec<&str> {
        ticks.labelled.iter().map(|(_, label)| label.as_str()).collect()
    }

    #[test]
    fn linear_ticks_are_round() {
        let ticks = linear(0.0, 1.05, 5);
        assert_eq!(written(&ticks), ["0.0", "0.5", "1.0"]);
        let ticks = linear(2.1e5, 8.2e5, 6);
        assert_eq!(written(&ticks), ["4", "6", "8"]);
        assert_eq!(ticks.unit("K"), "10⁵ K");
        assert_eq!(written(&linear(-0.3, 0.3, 6)), ["−0.3", "−0.2", "−0.1", "0.0", "0.1", "0.2", "0.3"]);
    }

    #[test]
    fn logarithmic_ticks_are_decades_or_their_parts() {
        assert_eq!(written(&logarithmic(1e3, 1e6, 8)), ["10³", "10⁴", "10⁵", "10⁶"]);
        let ticks = logarithmic(9e6, 8e7, 6);
        assert_eq!(written(&ticks), ["1", "1.5", "2", "3", "4", "5", "7"]);
        assert_eq!(ticks.unit("K"), "10⁷ K");
        assert_eq!(power_of_ten(-12), "10⁻¹²");
        // Less than a factor of two has too few round parts.
        assert!(logarithmic(1.05e5, 1.4e5, 6).labelled.len() >= 3);
    }

    #[test]
    fn hostile_ranges_end() {
        for (low, high) in [(0.0, 0.0), (1.0, 1.0), (1e308, 1.7e308), (-1e308, 1e308), (0.0, 5e-324)] {
            assert!(linear(low, high, 6).labelled.len() <= 1000);
        }
        assert!(logarithmic(1e-300, 1e300, 6).labelled.len() <= 10);
    }
}
