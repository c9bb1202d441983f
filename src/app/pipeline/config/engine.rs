//! The map method that `map.engine = "auto"` stands for.

use super::sections::Config;
use crate::imaging::EngineKind;
use crate::units::ChannelId;
use crate::units::constants::DAY_S;

/// Turn of the node, of a circle, below which C_l and errors of harmonic maps with R from the data may not hold. Mean squares of (map - sky) /
/// sigma: 40 after a week and 1.4 after a month at nside 16, 10,000 after a week at nside 4; of pixel maps of the weeks 2.8 and 4.6.
const NODE_TURN_MIN: f64 = 1.0 / 12.0;
/// nside up to which a pixel map of so short a mission takes minutes, and days of data of all channels: 40 of three take two.
const SHORT_NSIDE_MAX: usize = 16;
const CHANNEL_DAYS_MAX: f64 = 120.0;

impl Config {
    /// Replaces `map.engine = "auto"` by what orbits, positions and the other settings of maps allow; orbits that are not known may be any.
    pub(super) fn choose_engine(&mut self, knows_orbits: bool) {
        if self.map.engine == EngineKind::Auto {
            let is_circle = knows_orbits && self.array.is_circle() && !self.map.has_pixel_settings();
            let stays = !self.has_narrow_limits() || !self.corrects_positions();
            let is_harmonic = is_circle && stays && !self.is_better_in_pixels() || self.map.refine.is_on();
            self.map.engine = if is_harmonic { EngineKind::Harmonic } else { EngineKind::Pixel };
        }
    }

    /// Whether the node turns so little that errors of harmonic maps may not hold, and pixel maps are possible and take minutes.
    pub(super) fn is_better_in_pixels(&self) -> bool {
        let problems = |engine: EngineKind| {
            let mut config = self.clone();
            config.map.engine = engine;
            config.problems().iter().filter(|problem| problem.to_string().starts_with("map.")).count()
        };
        let Self { spacecraft, map, .. } = self;
        let channels = (0..).map(ChannelId).zip(&spacecraft.channels_hz).filter(|(id, _)| map.is_mapped(*id));
        let integrations = spacecraft.every_nth_integration.values().iter().min().copied().unwrap_or(1);
        let thinned: f64 =
            [spacecraft.thin, spacecraft.every_nth_window, integrations].map(|n| n as f64).iter().product();
        let channel_days = channels.count() as f64 * spacecraft.duration_s / DAY_S / thinned;
        self.has_short_coverage()
            && map.nside <= SHORT_NSIDE_MAX
            && channel_days <= CHANNEL_DAYS_MAX
            && !self.joint.on
            && problems(EngineKind::Pixel) <= problems(EngineKind::Harmonic)
    }

    /// Whether the node of a formation turns by less than a twelfth of a circle.
    pub(super) fn has_short_coverage(&self) -> bool {
        self.array.is_circle() && self.spacecraft.duration_s < NODE_TURN_MIN * self.array.precession_period_s
    }

    pub(super) fn with_chosen_engine(&self, knows_orbits: bool) -> Self {
        let mut config = self.clone();
        config.choose_engine(knows_orbits);
        config
    }
}
