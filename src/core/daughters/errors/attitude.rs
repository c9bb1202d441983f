//! Antennas that are tilted, or have patterns other than the ideal one.

use std::sync::Arc;

use super::series::Series;
use super::{InstrumentErrors, PassErrors};
use crate::array::{Array, tilted_axes, track_axes};
use crate::frames::{AntennaResponse, ObservingWindow};
use crate::response::model::AntennaPatterns;
use crate::response::pixel::SatelliteAntenna;
use crate::response::{AntennaQuery, MeasuredAntennas, PatternsByFrequency};

/// Antennas along the normal and the track of each daughter's own orbit.
pub struct OrbitAntennas {
    array: Arc<Array>,
    elements: AntennaResponse,
}

impl OrbitAntennas {
    /// Creates the ideal antennas of an array.
    #[must_use]
    pub fn new(array: Arc<Array>, elements: AntennaResponse) -> Self {
        Self { array, elements }
    }
}

impl AntennaPatterns for OrbitAntennas {
    fn antenna(&self, daughter: u8, t_s: f64) -> SatelliteAntenna {
        let number = usize::from(daughter);
        let (r_m, normal_hat) = (self.array.position_m(number, t_s), self.array.normal_hat(number, t_s));
        SatelliteAntenna::new(self.elements, tilted_axes(track_axes(r_m, normal_hat), [0.0; 2]), 0.0)
    }

    fn degree(&self) -> usize {
        self.elements.degree()
    }
}

/// Antennas of an instrument over its passes, in all channels.
pub struct AntennaErrors {
    array: Arc<Array>,
    elements: AntennaResponse,
    /// The daughters' patterns by frequency, without their errors.
    patterns: PatternsByFrequency,
    has_patterns: bool,
    measured: MeasuredAntennas,
    epoch_tai_s: f64,
    /// Start and end of each pass, s, and by daughter: tilt along the track, tilt away from the Moon, distortion.
    passes: Vec<([f64; 2], Vec<[Series; 3]>)>,
}

/// Antennas of an instrument at the frequency of a channel.
pub struct ChannelAntennas {
    antennas: Arc<AntennaErrors>,
    frequency_hz: f64,
}

impl AntennaErrors {
    /// The antennas that are measured, with their errors in these windows; `None` if all are ideal. Attitudes have dates, and the
    /// mission its epoch, s of TAI since 1958.
    #[must_use]
    pub fn new(
        errors: &InstrumentErrors,
        array: Arc<Array>,
        windows: &[ObservingWindow],
        elements: AntennaResponse,
        (measured, epoch_tai_s): (MeasuredAntennas, f64),
    ) -> Option<Arc<Self>> {
        let pass = |window: &ObservingWindow| {
            ([window.start.seconds(), window.end.seconds()], errors.antennas(*window))
        };
        let patterns = errors.config.pattern_by_frequency.clone();
        errors.config.has_own_antennas().then(|| {
            Arc::new(Self {
                array,
                elements,
                has_patterns: !errors.config.pattern.is_none()
                    || !patterns.is_ideal()
                    || measured.has_patterns(),
                measured,
                epoch_tai_s,
                patterns,
                passes: windows.iter().map(pass).collect(),
            })
        })
    }

    /// The antennas in a channel.
    #[must_use]
    pub fn at(self: &Arc<Self>, frequency_hz: f64) -> ChannelAntennas {
        ChannelAntennas { antennas: Arc::clone(self), frequency_hz }
    }

    /// Errors in the pass of a time, or the nearest one: powers are tabulated beyond a pass's ends.
    fn pass(&self, t_s: f64) -> Option<&[[Series; 3]]> {
        let begun = self.passes.partition_point(|([start_s, _], _)| *start_s <= t_s);
        let before = self.passes.get(begun.wrapping_sub(1));
        let after = self.passes.get(begun);
        let near = match (before, after) {
            (Some(before), Some(after)) if t_s - before.0[1] > after.0[0] - t_s => after,
            (Some(before), _) => before,
            (None, after) => after?,
        };
        Some(&near.1)
    }
}

impl AntennaPatterns for ChannelAntennas {
    fn antenna(&self, daughter: u8, t_s: f64) -> SatelliteAntenna {
        let AntennaErrors { array, elements, patterns, measured, epoch_tai_s, .. } = &*self.antennas;
        let number = usize::from(daughter);
        let errors = self.antennas.pass(t_s).and_then(|daughters| daughters.get(number));
        let [along_deg, radial_deg, distortion] =
            errors.map_or([0.0; 3], |errors| errors.each_ref().map(|series| series.at(t_s)));
        let (r_m, normal_hat) = (array.position_m(number, t_s), array.normal_hat(number, t_s));
        let distortion = patterns.q(number, self.frequency_hz) + distortion;
        let (satellite, tai_s, frequency_hz) = (number, epoch_tai_s + t_s, self.frequency_hz);
        let of = AntennaQuery { satellite, tai_s, frequency_hz, elements: *elements };
        measured.antenna(of, track_axes(r_m, normal_hat), [along_deg, radial_deg], distortion)
    }

    fn degree(&self) -> usize {
        // A factor of each pattern.
        self.antennas.elements.degree() + 4 * usize::from(self.antennas.has_patterns)
    }
}

impl PassErrors {
    /// Tilt of a daughter's antenna along the track and away from the Moon, deg, and the distortion of its pattern.
    #[must_use]
    pub fn antenna(&self, daughter: usize, t_s: f64) -> [f64; 3] {
        self.antennas[daughter].each_ref().map(|series| series.at(t_s))
    }
}
