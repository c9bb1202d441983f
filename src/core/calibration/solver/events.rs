//! Events of the instrument.

use std::fmt;

use serde::Serialize;

/// An event of the instrument.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
pub enum InstrumentEvent {
    /// The clock of a daughter jumped.
    ClockJump {
        /// Pass in which the event happened, or the first one after it.
        pass: u64,
        /// Last time before the event and first time after it, s since the epoch.
        between_s: [f64; 2],
        /// Daughter, from 1.
        daughter: u32,
        /// Change of the clock, ns.
        change_ns: f64,
    },
    /// Phases of a daughter changed.
    PhaseStep {
        /// Pass in which the event happened, or the first one after it.
        pass: u64,
        /// Last time before the event and first time after it, s since the epoch.
        between_s: [f64; 2],
        /// Daughter, from 1.
        daughter: u32,
        /// Channels, from 0, phase changes and their standard deviations, deg.
        channels: Vec<(usize, f64, f64)>,
    },
    /// Amplitudes of a daughter changed.
    GainStep {
        /// Pass in which the event happened, or the first one after it.
        pass: u64,
        /// Last time before the event and first time after it, s since the epoch.
        between_s: [f64; 2],
        /// Daughter, from 1.
        daughter: u32,
        /// Channels, from 0, factors of the amplitude and their standard deviations.
        channels: Vec<(usize, f64, f64)>,
    },
    /// A daughter delivers only noise from this pass on.
    Dead {
        /// First pass of this state.
        pass: u64,
        /// Daughter, from 1.
        daughter: u32,
        /// Channels, from 0.
        channels: Vec<usize>,
    },
    /// Phases of a daughter drift within a pass.
    Drift {
        /// Pass.
        pass: u64,
        /// Daughter, from 1.
        daughter: u32,
        /// Channels, from 0, and rms phase changes, deg.
        channels: Vec<(usize, f64)>,
    },
    /// Amplitudes of a daughter drift within a pass.
    GainDrift {
        /// Pass.
        pass: u64,
        /// Daughter, from 1.
        daughter: u32,
        /// Channels, from 0, and rms changes of the logarithm of the amplitude.
        channels: Vec<(usize, f64)>,
    },
    /// The model of the sky, or of the artificial signal, does not match the data.
    WrongModel {
        /// First pass of this state.
        pass: u64,
        /// Channel, from 0.
        channel: usize,
        /// Fraction of the signal that no gains explain.
        unexplained: f64,
    },
    /// The data are of another frequency than the model, or all baselines of another length.
    WrongFrequency {
        /// First pass of this state.
        pass: u64,
        /// Channel, from 0.
        channel: usize,
        /// Fraction of the signal that no gains explain.
        unexplained: f64,
        /// Frequency of the data over that of the model, or length of the baselines over that of their positions.
        ratio: f64,
    },
    /// The sky has a source that the model lacks, or has too faint.
    MissingSource {
        /// First pass of this state.
        pass: u64,
        /// Channel, from 0.
        channel: usize,
        /// Fraction of the signal that no gains explain.
        unexplained: f64,
        /// Ecliptic longitude and latitude, deg.
        position_deg: [f64; 2],
        /// Flux density, as an isotropic antenna sees it, Jy.
        flux_jy: f64,
    },
    /// The model is of another strength than the signal, or all receivers are.
    WrongStrength {
        /// First pass of this state.
        pass: u64,
        /// Channel, from 0.
        channel: usize,
        /// Strength of the model over that of the signal, if amplitudes are one on average.
        factor: f64,
    },
    /// The known signal is too weak for any gain.
    WeakSignal {
        /// First pass of this state.
        pass: u64,
        /// Channel, from 0.
        channel: usize,
    },
    /// A channel is disturbed.
    Interference {
        /// Pass.
        pass: u64,
        /// Channel, from 0.
        channel: usize,
        /// Fraction of its visibilities that are outliers.
        outliers: f64,
    },
    /// All channels are disturbed for a time.
    Burst {
        /// Pass.
        pass: u64,
        /// Start, s since the epoch.
        from_s: f64,
        /// End, s.
        until_s: f64,
    },
}

impl InstrumentEvent {
    /// Pass in which the event happened, or the first one after it.
    #[must_use]
    pub fn pass(&self) -> u64 {
        match self {
            Self::ClockJump { pass, .. }
            | Self::PhaseStep { pass, .. }
            | Self::GainStep { pass, .. }
            | Self::Dead { pass, .. }
            | Self::Drift { pass, .. }
            | Self::GainDrift { pass, .. }
            | Self::WrongModel { pass, .. }
            | Self::WrongFrequency { pass, .. }
            | Self::MissingSource { pass, .. }
            | Self::WrongStrength { pass, .. }
            | Self::WeakSignal { pass, .. }
            | Self::Interference { pass, .. }
            | Self::Burst { pass, .. } => *pass,
        }
    }
}

impl fmt::Display for InstrumentEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let list = |channels: &[(usize, f64)], unit: &str| {
            let each =
                channels.iter().map(|(channel, value)| format!("{value:.4}{unit} in channel {channel}"));
            each.collect::<Vec<_>>().join(", ")
        };
        match self {
            Self::ClockJump { pass, daughter, change_ns, between_s } => {
                let time_suffix = time_suffix(between_s);
                write!(
                    f,
                    "pass {pass}: the clock of daughter {daughter} jumped by {change_ns:.3} ns{time_suffix}"
                )
            }
            Self::PhaseStep { pass, daughter, channels, between_s } => {
                let (list, time_suffix) = (steps(channels, " deg"), time_suffix(between_s));
                write!(f, "pass {pass}: phases of daughter {daughter} changed by {list}{time_suffix}")
            }
            Self::GainStep { pass, daughter, channels, between_s } => {
                let (factors, time_suffix) = (steps(channels, ""), time_suffix(between_s));
                write!(
                    f,
                    "pass {pass}: amplitudes of daughter {daughter} changed by factors of {factors}{time_suffix}"
                )
            }
            Self::Dead { pass, daughter, channels } => {
                let channels: Vec<String> = channels.iter().map(usize::to_string).collect();
                write!(
                    f,
                    "pass {pass}: daughter {daughter} delivers noise in channels {}",
                    channels.join(", ")
                )
            }
            Self::Drift { pass, daughter, channels } => {
                let list = list(channels, " deg");
                write!(f, "pass {pass}: phases of daughter {daughter} drift within the pass by {list} rms")
            }
            Self::GainDrift { pass, daughter, channels } => {
                let percent: Vec<(usize, f64)> =
                    channels.iter().map(|(channel, rms)| (*channel, 100.0 * rms)).collect();
                let list = list(&percent, " %");
                write!(
                    f,
                    "pass {pass}: amplitudes of daughter {daughter} drift within the pass by {list} rms"
                )
            }
            Self::WrongModel { pass, channel, unexplained } => write!(
                f,
                "pass {pass}: the model does not match the data in channel {channel}: gains cannot explain {:.1} % of the signal",
                100.0 * unexplained
            ),
            Self::WrongFrequency { pass, channel, ratio, .. } => write!(
                f,
                "pass {pass}: the data of channel {channel} are as if its frequency, or all baselines, were about {ratio:.2} times what is stated"
            ),
            Self::MissingSource { pass, channel, position_deg: [longitude, latitude], flux_jy, .. } => {
                write!(
                    f,
                    "pass {pass}: the sky of channel {channel} has {flux_jy:.2e} Jy more than the model at ecliptic longitude {longitude:.1}, \
                 latitude {latitude:.1} deg"
                )
            }
            Self::WrongStrength { pass, channel, factor } => write!(
                f,
                "pass {pass}: the model of channel {channel} is {factor:.3} times as strong as the signal, if amplitudes are one on average: \
                 {:.3} is common to all",
                factor.sqrt().recip()
            ),
            Self::WeakSignal { pass, channel } => {
                write!(f, "pass {pass}: the known signal is too weak in channel {channel}: no gain is known")
            }
            Self::Interference { pass, channel, outliers } => write!(
                f,
                "pass {pass}: interference in channel {channel}, {:.1} % of its visibilities are outliers",
                100.0 * outliers
            ),
            Self::Burst { pass, from_s, until_s } => {
                write!(f, "pass {pass}: a burst in all channels from {from_s:.1} s to {until_s:.1} s")
            }
        }
    }
}

/// Text with steps of channels, and their standard deviations.
fn steps(channels: &[(usize, f64, f64)], unit: &str) -> String {
    let each = channels
        .iter()
        .map(|(channel, value, sigma)| format!("{value:.4} +- {sigma:.4}{unit} in channel {channel}"));
    each.collect::<Vec<_>>().join(", ")
}

/// Text with the time of an event, if it is known to 1 s.
fn time_suffix([from_s, until_s]: &[f64; 2]) -> String {
    if until_s - from_s > 1.0 { String::new() } else { format!(", at {:.1} s", 0.5 * (from_s + until_s)) }
}
