//! Notes on baselines: a long simulation of those that no map uses, and channels that have none for their map.

use super::estimate::{ChannelCost, Cost, Segment};
use crate::mother::Fidelity;
use crate::pipeline::config::{PipelineError, Plan};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::{ChannelId, PerChannel};

/// Least estimated time that is noted, s.
const NOTED_S: f64 = 60.0;
/// Greatest part of the time that a limit leaves if it is noted.
const LEFT_MAX: f64 = 0.5;

impl Plan {
    /// A note if `spacecraft.baseline_wavelengths_max` sets no limit, and a run of a minute or more is mostly of baselines that no map uses.
    /// `cost` is that of this plan, and `segment` what is run of it.
    #[must_use]
    #[doc(hidden)]
    pub fn baseline_note(&self, cost: &Cost, segment: Segment) -> Option<String> {
        let (map, spacecraft) = (&self.config.map, &self.config.spacecraft);
        let limits = &spacecraft.baseline_wavelengths_max;
        let channels = || cost.channels.iter().enumerate();
        let sent: f64 = channels().map(|(_, channel)| channel.visibilities_sent).sum();
        let is_mapped = |number: usize| map.is_mapped(ChannelId(number as u16));
        let used = channels().filter(|(number, _)| is_mapped(*number));
        let used: f64 = used.map(|(_, channel)| channel.visibilities_mapped).sum();
        let time_s = cost.segment_s(segment);
        let is_open = limits.values().contains(&0.0) && spacecraft.fidelity != Fidelity::Samples;
        if !is_open || used >= sent || time_s < NOTED_S {
            return None;
        }
        // The same at all frequencies, as a map has one nside.
        let frequency_hz = *spacecraft.channels_hz.first()?;
        let limit = map.baseline_m_max(frequency_hz) * frequency_hz / SPEED_OF_LIGHT_M_S;
        let limit = (10.0 * limit).ceil() / 10.0;
        let mut config = self.config.clone();
        config.spacecraft.baseline_wavelengths_max =
            limits.map(|before| if *before > 0.0 { *before } else { limit });
        let ranks = cost.ranks.map_or(1, |ranks| ranks.ranks);
        let limited_s = Self::new(config).ok()?.cost_with_ranks(ranks).segment_s(segment);
        if limited_s > LEFT_MAX * time_s {
            return None;
        }
        let (share, nside) = (100.0 * used / sent, map.nside);
        let key = match limits {
            PerChannel::All(_) => "spacecraft.baseline_wavelengths_max = ",
            PerChannel::Each(_) => "0 in spacecraft.baseline_wavelengths_max replaced by ",
        };
        Some(format!(
            "of {sent:.1e} visibilities, maps use {used:.1e} ({share:.0} %): baselines have no limit, and those of maps of nside {nside} have \
             one (map.baseline_bp_max). The estimate is {} for all, and {} with {key}{limit:.1}, which leaves out what these maps cannot use; \
             finer maps, `lunarray zoom`, calibration and bursts do use it",
            time_text(time_s),
            time_text(limited_s)
        ))
    }
}

impl Plan {
    /// A note if some channels to map have no baseline within their limits in the middle of any window, so that a run makes no map of them.
    /// `cost` is that of this plan.
    #[must_use]
    #[doc(hidden)]
    pub fn unmapped_note(&self, cost: &Cost) -> Option<String> {
        let name = |channel: &ChannelCost| {
            let key = match channel.visibilities_sent > 0.0 {
                true => "map.baseline_bp_max",
                false => "spacecraft.baseline_wavelengths_max",
            };
            format!("{:.3} MHz ({key})", channel.frequency_hz / 1e6)
        };
        let unmapped: Vec<String> =
            self.to_map(cost).filter(|channel| is_unmapped(channel)).map(name).collect();
        (!unmapped.is_empty()).then(|| {
            format!(
                "no map of {}: no baseline is below the limit in the middle of any observing window; expected a larger limit, or satellites \
                 closer together",
                unmapped.join(", ")
            )
        })
    }

    /// Requires a baseline within its limits for at least one channel to map; a run without it ends without a map, which is an error.
    ///
    /// # Errors
    /// [`PipelineError::NoBaseline`].
    #[doc(hidden)]
    pub fn require_baseline(&self, cost: &Cost) -> Result<(), PipelineError> {
        let is_without = self.to_map(cost).all(is_unmapped);
        self.unmapped_note(cost)
            .filter(|_| is_without)
            .map_or(Ok(()), |note| Err(PipelineError::NoBaseline(note)))
    }

    /// Costs of the channels to map.
    fn to_map<'a>(&'a self, cost: &'a Cost) -> impl Iterator<Item = &'a ChannelCost> {
        let numbered = (0..).map(ChannelId).zip(&cost.channels);
        numbered.filter(|(channel, _)| self.config.map.is_mapped(*channel)).map(|(_, cost)| cost)
    }
}

fn is_unmapped(channel: &ChannelCost) -> bool {
    channel.visibilities_mapped == 0.0
}

impl Cost {
    /// Estimated time of a segment, s.
    fn segment_s(&self, segment: Segment) -> f64 {
        match segment {
            Segment::Whole => self.predicted_s,
            Segment::Space => {
                self.predicted_s - self.channels.iter().map(|channel| channel.mapping_s).sum::<f64>()
            }
        }
    }
}

fn time_text(time_s: f64) -> String {
    match time_s {
        time_s if time_s < 90.0 => format!("{time_s:.0} s"),
        time_s if time_s < 5400.0 => format!("{:.0} min", time_s / 60.0),
        time_s => format!("{:.1} h", time_s / 3600.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::config::ConfigSource;

    fn plan(sets: &[&str]) -> Plan {
        let overrides = sets.iter().map(|set| (*set).to_owned()).collect();
        Plan::new(ConfigSource { overrides, ..ConfigSource::default() }.load().unwrap()).unwrap()
    }

    fn note(more: &[&str], segment: Segment) -> Option<String> {
        let sets = [
            "spacecraft.channels_hz=[3e6]",
            "spacecraft.every_nth_window=1",
            "spacecraft.every_nth_integration=1",
            "spacecraft.baseline_wavelengths_max=0",
            "map.nside=16",
        ];
        let plan = plan(&[&sets[..], more].concat());
        plan.baseline_note(&plan.cost(), segment)
    }

    #[test]
    fn baselines_that_no_map_uses_are_noted_with_the_limit_to_set() {
        for segment in [Segment::Whole, Segment::Space] {
            let said = note(&[], segment).unwrap();
            // 2 b_p at nside 16: a pixel's side is sqrt(4 pi / 3072) = 0.06396 rad, and 2 / 0.06396 = 31.27.
            assert!(said.contains("with spacecraft.baseline_wavelengths_max = 31.3, which"), "{said}");
            assert!(said.contains("maps of nside 16") && said.contains("The estimate is "), "{said}");
        }
        let said = note(&["spacecraft.baseline_wavelengths_max=[0]"], Segment::Whole).unwrap();
        assert!(said.contains("0 in spacecraft.baseline_wavelengths_max replaced by 31.3"), "{said}");
    }

    #[test]
    fn a_limit_maps_of_all_baselines_and_short_runs_are_not_noted() {
        for more in [
            "spacecraft.baseline_wavelengths_max=31.3",
            "spacecraft.baseline_wavelengths_max=4000",
            "map.baseline_bp_max=1e6",
            "spacecraft.thin=100000",
        ] {
            assert_eq!(note(&[more], Segment::Whole), None, "{more}");
        }
    }

    #[test]
    fn channels_without_a_baseline_are_named_and_fail_if_there_are_no_others() {
        // The shortest baseline is some 100 m (paper): 10 wavelengths at 30 MHz, and one at 3 MHz. A map's limit of 2 b_p at nside 4 is 7.8.
        for (sets, key) in [
            (
                ["map.nside=16", "spacecraft.baseline_wavelengths_max=8"],
                "spacecraft.baseline_wavelengths_max",
            ),
            (["map.nside=4", "spacecraft.baseline_wavelengths_max=31.3"], "map.baseline_bp_max"),
        ] {
            let found = |channels: &str| {
                let channels = format!("spacecraft.channels_hz={channels}");
                let plan = plan(&[&sets[..], &[&channels]].concat());
                let cost = plan.cost();
                (plan.unmapped_note(&cost), plan.require_baseline(&cost).is_ok())
            };
            let note = format!("no map of 30.000 MHz ({key}): ");
            for (channels, is_good) in [("[3e6, 30e6]", true), ("[30e6]", false)] {
                let (said, is_accepted) = found(channels);
                assert!(said.as_ref().is_some_and(|said| said.starts_with(&note)), "{said:?}");
                assert_eq!(is_accepted, is_good, "{channels}");
            }
            assert_eq!(found("[3e6]"), (None, true));
        }
    }
}
