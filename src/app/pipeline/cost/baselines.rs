//! Note on a long simulation of baselines that no map uses.

use super::estimate::{Cost, Segment};
use crate::mother::Fidelity;
use crate::pipeline::config::Plan;
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

    fn note(more: &[&str], segment: Segment) -> Option<String> {
        let sets = [
            "spacecraft.channels_hz=[3e6]",
            "spacecraft.every_nth_window=1",
            "spacecraft.every_nth_integration=1",
            "spacecraft.baseline_wavelengths_max=0",
            "map.nside=16",
        ];
        let overrides = sets.iter().chain(more).map(|set| (*set).to_owned()).collect();
        let plan = Plan::new(ConfigSource { overrides, ..ConfigSource::default() }.load().unwrap()).unwrap();
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
}
