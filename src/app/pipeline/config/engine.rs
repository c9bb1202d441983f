//! The map method that `map.engine = "auto"` stands for.

use super::sections::Config;
use crate::imaging::EngineKind;

impl Config {
    /// Replaces `map.engine = "auto"` by what orbits, positions and the other settings of maps allow; orbits that are not known may be any.
    pub(super) fn choose_engine(&mut self, knows_orbits: bool) {
        if self.map.engine == EngineKind::Auto {
            let is_circle = knows_orbits && self.array.is_circle() && !self.map.has_pixel_settings();
            let stays = !self.has_narrow_limits() || !self.corrects_positions();
            let is_harmonic = is_circle && stays || self.map.refine.is_on();
            self.map.engine = if is_harmonic { EngineKind::Harmonic } else { EngineKind::Pixel };
        }
    }

    pub(super) fn with_chosen_engine(&self, knows_orbits: bool) -> Self {
        let mut config = self.clone();
        config.choose_engine(knows_orbits);
        config
    }
}
