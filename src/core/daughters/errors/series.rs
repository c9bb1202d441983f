//! Time series of one error of one daughter over a pass, drawn from the seed alone: independent of the order in which
//! passes are requested.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::config::ErrorTerms;
use crate::units::constants::DAY_S;
use crate::units::{StreamKind, random_stream};

/// Number of nodes of a Gauss-Markov process per correlation time. Linear interpolation between them lacks 1 / (6 x
/// 64) of its variance half-way.
const NODES_PER_TIME: f64 = 64.0;
/// Minimum number of correlation times between independent values of a process: the neglected correlation is exp(-32)
/// = 1e-14. The number of nodes between is a power of two.
const INDEPENDENT_TIMES: f64 = 32.0;
/// Spacing of the nodes of a clock's noise, s.
const WALK_STEP_S: f64 = 1.0;

/// Identity of an error in the random streams.
#[derive(Clone, Copy, Debug)]
pub(super) struct Draws {
    /// Seed of the realisation.
    pub(super) seed: u64,
    /// Number of the error.
    pub(super) error: u8,
    /// Daughter, from 0.
    pub(super) daughter: usize,
    /// Channel, from 0.
    pub(super) channel: usize,
}

/// Random terms, as the second byte of a stream's identity.
#[derive(Clone, Copy)]
enum Term {
    Constant = 0,
    Pass = 1,
    Orbit = 2,
    Drift = 3,
    Step = 4,
    Walk = 5,
}

impl Draws {
    fn stream(self, term: Term, index: i64) -> impl Rng + use<> {
        let Self { seed, error, daughter, channel } = self;
        let of = u64::from(error) << 40 | (term as u64) << 32 | (daughter as u64) << 16 | channel as u64;
        random_stream(seed, StreamKind::Instrument, [of, index as u64])
    }

    fn normal(self, term: Term, index: i64) -> f64 {
        StandardNormal.sample(&mut self.stream(term, index))
    }
}

/// An error over a pass.
#[derive(Clone, Debug)]
pub(super) struct Series {
    /// Constant part in the pass.
    level: f64,
    /// Rate since the epoch, per second.
    rate_per_s: f64,
    /// Factors of the cosine and the sine of the orbital phase since the epoch.
    orbit: [f64; 2],
    orbit_rad_per_s: f64,
    /// Index of the first node, step (s), and values of the drift.
    drift: Option<(i64, f64, Vec<f64>)>,
    /// Index of the first node, step (s), and values of a clock's noise.
    walk: Option<(i64, f64, Vec<f64>)>,
    /// Level since each of these times, s; the first applies before, too.
    steps: Vec<(f64, f64)>,
}

impl Series {
    /// Draws the error over pass `index` from `from_s` to `until_s`, with an orbital period.
    pub(super) fn new(
        terms: &ErrorTerms,
        draws: Draws,
        (index, [from_s, until_s]): (u64, [f64; 2]),
        period_s: f64,
    ) -> Self {
        let value_of = |list: &[f64]| list.get(draws.daughter).copied().unwrap_or(0.0);
        let random = |rms: f64, term, index: i64| {
            if rms > 0.0 { rms * draws.normal(term, index) } else { 0.0 }
        };
        Self {
            level: value_of(&terms.constant)
                + random(terms.constant_rms, Term::Constant, 0)
                + random(terms.pass_rms, Term::Pass, index as i64),
            rate_per_s: value_of(&terms.rate_per_day) / DAY_S,
            orbit: [0, 1].map(|part| random(terms.orbit_rms, Term::Orbit, part)),
            orbit_rad_per_s: std::f64::consts::TAU / period_s,
            drift: (terms.drift_rms > 0.0).then(|| {
                let process =
                    Process { rms: terms.drift_rms, time_s: terms.drift_time_s, nodes: NODES_PER_TIME };
                process.values_over([from_s, until_s], &|node| draws.normal(Term::Drift, node))
            }),
            walk: None,
            steps: if terms.step_rms > 0.0 { steps(terms, draws, [from_s, until_s]) } else { Vec::new() },
        }
    }

    /// Adds a random walk over an interval, whose increments have a variance of `per_root_s`^2 per second, and which
    /// steering removes within `steering_s`.
    pub(super) fn with_walk(self, per_root_s: f64, steering_s: f64, draws: Draws, span_s: [f64; 2]) -> Self {
        // Increments over t of a Gauss-Markov process have 2 rms^2 (1 - exp(-t / time)).
        let process = Process {
            rms: per_root_s * (0.5 * steering_s).sqrt(),
            time_s: steering_s,
            nodes: steering_s / WALK_STEP_S,
        };
        let walk = || process.values_over(span_s, &|node| draws.normal(Term::Walk, node));
        Self { walk: (per_root_s > 0.0).then(walk), ..self }
    }

    /// Value at a time, s since the epoch.
    pub(super) fn at(&self, t_s: f64) -> f64 {
        let mut value = self.level + self.rate_per_s * t_s;
        if self.orbit != [0.0; 2] {
            let (sin, cos) = (self.orbit_rad_per_s * t_s).sin_cos();
            value += self.orbit[0] * cos + self.orbit[1] * sin;
        }
        for (first, step_s, nodes) in [&self.drift, &self.walk].into_iter().flatten() {
            // Time is counted in whole nodes since the epoch, so that no bit depends on the start of the pass.
            let place = t_s / step_s;
            let node = (place.floor() as i64).clamp(*first, first + nodes.len() as i64 - 2);
            let [before, after] = [0, 1].map(|k| nodes[(node - first) as usize + k]);
            value += before + (after - before) * (place - node as f64).clamp(0.0, 1.0);
        }
        let begun = self.steps.partition_point(|(since_s, _)| *since_s <= t_s);
        value + self.steps.get(begun.max(1) - 1).map_or(0.0, |(_, level)| *level)
    }
}

/// A stationary Gauss-Markov process.
struct Process {
    rms: f64,
    /// Correlation time, s.
    time_s: f64,
    /// Number of nodes per correlation time.
    nodes: f64,
}

impl Process {
    /// Index of the first node, step (s) and values over an interval. A node is drawn between two known nodes, from
    /// the coarsest level to the finest, so that any interval has the same values independent of earlier ones.
    fn values_over(&self, [from_s, until_s]: [f64; 2], draw: &dyn Fn(i64) -> f64) -> (i64, f64, Vec<f64>) {
        let step_s = self.time_s / self.nodes;
        let independent = ((INDEPENDENT_TIMES * self.nodes).ceil() as u64).next_power_of_two() as i64;
        let [first, last] = [(from_s / step_s).floor() as i64, (until_s / step_s).ceil() as i64 + 1];
        let mut nodes = vec![0.0; (last - first + 1) as usize];
        let mut bridge = Bridge { draw, first, nodes: &mut nodes, nodes_per_time: self.nodes };
        let mut left = first.div_euclid(independent) * independent;
        while left <= last {
            let right = left + independent;
            let ends = [draw(left), draw(right)];
            bridge.set(left, ends[0]);
            bridge.set(right, ends[1]);
            bridge.fill([left, right], ends);
            left = right;
        }
        nodes.iter_mut().for_each(|node| *node *= self.rms);
        (first, step_s, nodes)
    }
}

/// Midpoint sampling of nodes between two known ones.
struct Bridge<'a> {
    draw: &'a dyn Fn(i64) -> f64,
    first: i64,
    nodes: &'a mut [f64],
    nodes_per_time: f64,
}

impl Bridge<'_> {
    fn set(&mut self, node: i64, value: f64) {
        let place = usize::try_from(node - self.first).ok();
        if let Some(slot) = place.and_then(|place| self.nodes.get_mut(place)) {
            *slot = value;
        }
    }

    fn fill(&mut self, [left, right]: [i64; 2], ends: [f64; 2]) {
        let outside = right < self.first || left > self.first + self.nodes.len() as i64;
        if right - left < 2 || outside {
            return;
        }
        let middle = left + (right - left) / 2;
        // The correlation is r to either end, and r^2 between the ends.
        let r = (-((middle - left) as f64) / self.nodes_per_time).exp();
        let deviation = ((1.0 - r * r) / (1.0 + r * r)).sqrt();
        let value = (ends[0] + ends[1]) * r / (1.0 + r * r) + deviation * (self.draw)(middle);
        self.set(middle, value);
        self.fill([left, middle], [ends[0], value]);
        self.fill([middle, right], [value, ends[1]]);
    }
}

/// Levels over an interval, each with the time of its jump.
fn steps(terms: &ErrorTerms, draws: Draws, [from_s, until_s]: [f64; 2]) -> Vec<(f64, f64)> {
    let every_s = terms.step_every_s;
    let cell = |k: i64| {
        let mut stream = draws.stream(Term::Step, k);
        let part = f64::from(stream.next_u32()) / 2.0_f64.powi(32);
        let level: f64 = StandardNormal.sample(&mut stream);
        ((k as f64 + part) * every_s, terms.step_rms * level)
    };
    let [first, last] = [from_s, until_s].map(|t_s| (t_s / every_s).floor() as i64);
    (first - 1..=last).map(cell).collect()
}

/// Whether a burst that occurs once in each `every_s` and lasts `length_s` is on at a time.
pub(super) fn burst_is_on(seed: u64, [every_s, length_s]: [f64; 2], t_s: f64) -> bool {
    let draws = Draws { seed, error: u8::MAX, daughter: 0, channel: 0 };
    let cell = (t_s / every_s).floor() as i64;
    let start_s = |k: i64| {
        let part = f64::from(draws.stream(Term::Step, k).next_u32()) / 2.0_f64.powi(32);
        (k as f64 + part) * every_s
    };
    [cell - 1, cell].into_iter().any(|k| (0.0..length_s).contains(&(t_s - start_s(k))))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn draws(daughter: usize) -> Draws {
        Draws { seed: 5, error: 1, daughter, channel: 0 }
    }

    #[test]
    fn a_drift_has_the_variance_and_correlation_of_its_process() {
        let terms = ErrorTerms { drift_rms: 2.0, drift_time_s: 640.0, ..ErrorTerms::default() };
        // Times are one and a half correlation times apart, in passes far from each other.
        let (mut squares, mut products, mut far, mut count) = (0.0, 0.0, 0.0, 0.0);
        for pass in 0..4000_u64 {
            let from_s = 1e5 * pass as f64 + 0.37 * pass as f64;
            let series = Series::new(&terms, draws(0), (pass, [from_s, from_s + 2000.0]), 8000.0);
            let [a, b, c] = [0.0, 320.0, 1280.0].map(|after_s| series.at(from_s + after_s));
            squares += a * a + b * b + c * c;
            products += a * b;
            far += a * c;
            count += 1.0;
        }
        // Four standard deviations of 4000 products of Gaussians of variance 4: 4 x 4 sqrt(2 / 4000) for squares.
        assert!((squares / count / 3.0 - 4.0).abs() < 0.25, "{}", squares / count / 3.0);
        assert!((products / count - 4.0 * (-0.5_f64).exp()).abs() < 0.33, "{}", products / count);
        assert!((far / count - 4.0 * (-2.0_f64).exp()).abs() < 0.33, "{}", far / count);
    }

    #[test]
    fn a_clock_has_the_configured_allan_deviation() {
        // 3e-11 at 1 s, in ns; steered within some thirty hours.
        let (at_1_s, steering_s) = (0.03, 1e5);
        let none = ErrorTerms::default();
        let clock = |pass: u64| {
            let from_s = 8_248.68 * pass as f64;
            let span_s = [from_s, from_s + 2750.0];
            let series = Series::new(&none, draws(0), (pass, span_s), 8000.0);
            (from_s, series.with_walk(at_1_s, steering_s, draws(0), span_s))
        };
        for tau_s in [10.0, 100.0, 300.0_f64] {
            let (mut sum, mut count) = (0.0, 0.0);
            for pass in 0..400 {
                let (from_s, clock) = clock(pass);
                // Far enough apart to be independent.
                for k in 0..(2700.0 / (2.0 * tau_s)) as usize {
                    let [a, b, c] = [0.0, 1.0, 2.0].map(|m| clock.at(from_s + tau_s * (2.0 * k as f64 + m)));
                    sum += (c - 2.0 * b + a).powi(2);
                    count += 1.0;
                }
            }
            // sigma_y^2 = <(x_2 - 2 x_1 + x_0)^2> / (2 tau^2).
            // Straight lines between nodes of 1 s lack 1 / 6 of a second's variance at each of the three instants, with weights
            // 1, 4 and 1 of 2 tau.
            let lines = 1.0 - 1.0 / (2.0 * tau_s);
            let (found, law) = ((sum / count / 2.0).sqrt() / tau_s, at_1_s * (lines / tau_s).sqrt());
            // Four standard deviations of a deviation from `count` values, and what steering takes.
            let bound = 4.0 / (2.0 * count).sqrt() + tau_s / steering_s;
            assert!((found / law - 1.0).abs() < bound, "{tau_s} s: {found} for {law}, within {bound}");
        }
        // Any interval has the same values.
        let (from_s, whole) = clock(7);
        let span_s = [from_s + 1000.0, from_s + 1100.0];
        let part =
            Series::new(&none, draws(0), (7, span_s), 8000.0).with_walk(at_1_s, steering_s, draws(0), span_s);
        for k in 0..100 {
            let t_s = from_s + 1000.0 + f64::from(k);
            assert_eq!(whole.at(t_s), part.at(t_s));
        }
    }

    #[test]
    fn any_interval_has_the_same_values() {
        let terms = ErrorTerms {
            pass_rms: 1.0,
            orbit_rms: 0.5,
            drift_rms: 2.0,
            drift_time_s: 100.0,
            step_rms: 3.0,
            step_every_s: 500.0,
            ..ErrorTerms::default()
        };
        let whole = Series::new(&terms, draws(3), (7, [1e4, 1.4e4]), 8000.0);
        let part = Series::new(&terms, draws(3), (7, [1.21e4, 1.25e4]), 8000.0);
        for t_s in (0..400).map(|k| 1.21e4 + f64::from(k)) {
            assert_eq!(whole.at(t_s), part.at(t_s), "{t_s}");
        }
        let other = Series::new(&terms, draws(4), (7, [1e4, 1.4e4]), 8000.0);
        assert_ne!(whole.at(1.2e4), other.at(1.2e4));
    }

    #[test]
    fn levels_jump_once_per_interval() {
        let terms = ErrorTerms { step_rms: 1.0, step_every_s: 100.0, ..ErrorTerms::default() };
        let series = Series::new(&terms, draws(0), (0, [1000.0, 3000.0]), 8000.0);
        let values: Vec<f64> = (0..20_000).map(|k| series.at(1000.0 + 0.1 * f64::from(k))).collect();
        let jumps = values.windows(2).filter(|two| two[0] != two[1]).count();
        assert!((19..=21).contains(&jumps), "{jumps}");
    }

    #[test]
    fn bursts_are_on_for_their_fraction_of_time() {
        let on = (0..100_000).filter(|k| burst_is_on(9, [1000.0, 50.0], f64::from(*k))).count();
        // One of 50 s in each 1000 s; the one cut at an end counts less.
        assert!((4900..=5000).contains(&on), "{on}");
    }
}
