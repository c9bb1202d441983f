//! Errors of reported positions and times: orbit determination and the formation's clock.

use super::config::ErrorTerms;
use crate::units::{Checks, InvalidValue, keys};

/// Maximum error of a time tag, s. Ephemeris packets reach as far beyond a pass, so that tags find positions.
pub(super) const TIME_TAG_S_MAX: f64 = 10.0;

/// Maximum errors, m or ms, and maximum rates per day. Beyond these the satellites would not form an array.
const MOST: f64 = 1e6;

keys! {
    /// The `[navigation]` section: what the packets say less what is true. Without any of it, data are as they are without the
    /// section.
    pub struct NavigationConfig {
        /// Error of the position along the track, by daughter.
        section along_m: ErrorTerms = ErrorTerms::default();
        /// Error of the position along the orbit's normal, by daughter.
        section across_m: ErrorTerms = ErrorTerms::default();
        /// Error of the position away from the Moon, by daughter.
        section radial_m: ErrorTerms = ErrorTerms::default();
        /// Error of the time tags of all data, one for the formation.
        section time_tag_ms: ErrorTerms = ErrorTerms::default();
    }
}

impl NavigationConfig {
    /// Whether reported positions or times have errors.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.terms().iter().any(|(_, terms)| !terms.is_none())
    }

    /// Whether time tags have errors.
    #[must_use]
    pub fn has_tag_errors(&self) -> bool {
        !self.time_tag_ms.is_none()
    }

    /// Whether anything changes within a pass.
    #[must_use]
    pub fn changes_in_a_pass(&self) -> bool {
        self.terms().iter().any(|(_, terms)| terms.changes_in_a_pass())
    }

    fn terms(&self) -> [(&'static str, &ErrorTerms); 4] {
        [
            ("along_m", &self.along_m),
            ("across_m", &self.across_m),
            ("radial_m", &self.radial_m),
            ("time_tag_ms", &self.time_tag_ms),
        ]
    }

    /// All invalid values for an array of `satellites`; empty if there are none.
    #[must_use]
    pub fn problems(&self, satellites: usize) -> Vec<InvalidValue> {
        let mut checks = Checks::new("navigation");
        for (name, terms) in self.terms() {
            let of_tags = name == "time_tag_ms";
            let of = if of_tags { (1, "for the formation") } else { (satellites, "a daughter") };
            terms.check(name, of, [MOST; 2], !of_tags, &mut checks);
        }
        let terms = &self.time_tag_ms;
        let rms = [terms.constant_rms, terms.pass_rms, terms.orbit_rms, terms.drift_rms, terms.step_rms];
        let most = terms.constant.iter().chain(&rms).fold(0.0, |most: f64, ms| most.max(ms.abs()));
        let most_ms = 1e3 * TIME_TAG_S_MAX;
        let expected =
            format!("time tags that are off by at most {most_ms} ms; further ones are kept to that");
        checks.number("time_tag_ms", most, most <= most_ms, expected);
        checks.finish()
    }
}
