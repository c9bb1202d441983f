//! Draws the integration time received and missing over mission time.

use super::pictures::{Axis, Curve, Picture, PictureError, Plot, draw_plots};
use crate::downlink::PacketKind;
use crate::ground::archive::{ChannelCoverage, CoverageSurvey, Gaps, JournalEntry};
use crate::units::constants::DAY_S;

const BINS: usize = 240;
const PLOTS_MAX: usize = 64;

struct TimeBins {
    first_s: f64,
    last_s: f64,
    bin_s: f64,
}

impl TimeBins {
    fn new<'a>(entries: impl Iterator<Item = &'a JournalEntry> + Clone) -> Self {
        let first_s = entries.clone().map(|entry| entry.start.seconds()).fold(f64::INFINITY, f64::min);
        let last_s = entries.map(|entry| entry.end.seconds()).fold(f64::NEG_INFINITY, f64::max);
        Self { first_s, last_s, bin_s: ((last_s - first_s) / BINS as f64).max(1.0) }
    }

    fn bin(&self, time_s: f64) -> usize {
        (((time_s - self.first_s) / self.bin_s).max(0.0) as usize).min(BINS - 1)
    }

    fn edge_s(&self, bin: usize) -> f64 {
        self.first_s + self.bin_s * bin as f64
    }

    /// Points of a step curve, hours over days.
    fn steps(&self, sums_s: &[f64]) -> Vec<(f64, f64)> {
        let day = |bin: usize| self.edge_s(bin) / DAY_S;
        let corners = |(k, &sum): (usize, &f64)| [(day(k), sum / 3600.0), (day(k + 1), sum / 3600.0)];
        sums_s.iter().enumerate().flat_map(corners).collect()
    }
}

/// Draws integration time over mission time for each channel: received, and received plus missing.
///
/// # Errors
/// [`PictureError::Size`] if nothing has been received. Only the first 64 channels are shown.
pub fn draw_coverage(survey: &CoverageSurvey, gaps: &Gaps) -> Result<Picture, PictureError> {
    let packets = &survey.received().packets;
    let bins = TimeBins::new(packets.iter().map(|packet| &packet.entry));
    // Without packets there is no time axis; `draw_plots` refuses zero plots.
    let plots_max = if packets.is_empty() { 0 } else { PLOTS_MAX };
    let plots: Vec<Plot> =
        gaps.channels.iter().take(plots_max).map(|channel| plot(survey, gaps, channel, &bins)).collect();
    draw_plots("Integration time received", &plots, 1 + usize::from(plots.len() > 3))
}

fn plot(survey: &CoverageSurvey, gaps: &Gaps, coverage: &ChannelCoverage, bins: &TimeBins) -> Plot {
    let mut received_s = vec![0.0; BINS];
    for entry in survey.received().packets.iter().map(|packet| &packet.entry) {
        if entry.channel.0 == coverage.channel && entry.pair.i != entry.pair.j {
            let middle_s = 0.5 * (entry.start.seconds() + entry.end.seconds());
            received_s[bins.bin(middle_s)] += entry.integration_s;
        }
    }
    let mut all_s = received_s.clone();
    add_missing(survey, gaps, coverage.channel, bins, &mut all_s);
    Plot {
        title: match coverage.frequency_hz {
            Some(hz) => format!("channel {}: {:.4} MHz", coverage.channel, hz / 1e6),
            None => format!("channel {}", coverage.channel),
        },
        x: Axis { label: "mission time, days".into(), ..Axis::default() },
        y: Axis { label: format!("baseline hours per {:.2} d", bins.bin_s / DAY_S), ..Axis::default() },
        curves: vec![
            Curve { label: "received and missing".into(), points: bins.steps(&all_s), dashed: true },
            Curve { label: "received".into(), points: bins.steps(&received_s), dashed: false },
        ],
        levels: Vec::new(),
    }
}

/// Adds the missing integration time of a channel, distributed over the observed parts of its gaps.
fn add_missing(survey: &CoverageSurvey, gaps: &Gaps, channel: u16, bins: &TimeBins, sums_s: &mut [f64]) {
    for gap in gaps.gaps.iter().filter(|gap| gap.kind == PacketKind::Visibilities) {
        let of_channel = gap.lost.iter().filter(|lost| lost.channel == channel);
        let lost_s: f64 = of_channel.map(|lost| lost.integration_s).sum();
        let [from, to] = gap.between_s;
        let spans = survey.observed_s([from.unwrap_or(bins.first_s), to.unwrap_or(bins.last_s)]);
        let length_s: f64 = spans.iter().map(|[from, to]| to - from).sum();
        for [from, to] in spans {
            let within = bins.bin(from)..=bins.bin(to);
            for (k, sum) in within.clone().zip(&mut sums_s[within]) {
                let within_s = (bins.edge_s(k + 1).min(to) - bins.edge_s(k).max(from)).max(0.0);
                *sum += lost_s * within_s / length_s;
            }
        }
    }
}
