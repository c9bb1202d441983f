//! Antennas that are tilted, or whose pattern is not the ideal one.

use std::sync::Arc;

use super::series::Series;
use super::{InstrumentErrors, PassErrors};
use crate::array::{Array, track_axes};
use crate::frames::ObservingWindow;
use crate::response::model::AntennaPatterns;
use crate::response::pixel::TiltedAntenna;
use crate::units::vector::{Vec3, add, scale, unit};

/// Axis of a dipole that leans from the orbit's normal by an angle (deg) towards the track's direction, and by one away
/// from the Moon.
pub(super) fn tilted_axis(r_m: Vec3, normal_hat: Vec3, [along_deg, radial_deg]: [f64; 2]) -> Vec3 {
    let [along, normal, up] = track_axes(r_m, normal_hat);
    let [a, b] = [along_deg, radial_deg].map(|deg| deg.to_radians().tan());
    unit(add(normal, add(scale(a, along), scale(b, up))))
}

/// The antennas of an instrument over its passes.
pub struct AntennaErrors {
    array: Arc<Array>,
    is_dipole: bool,
    /// Start and end, s, and by daughter: tilt along the track, tilt away from the Moon, distortion.
    passes: Vec<([f64; 2], Vec<[Series; 3]>)>,
}

impl AntennaErrors {
    /// Those of errors in these windows; `None` if all antennas are ideal. `is_dipole` says whether they are dipoles.
    #[must_use]
    pub fn new(
        errors: &InstrumentErrors,
        array: Arc<Array>,
        windows: &[ObservingWindow],
        is_dipole: bool,
    ) -> Option<Self> {
        let pass = |window: &ObservingWindow| {
            ([window.start.seconds(), window.end.seconds()], errors.antennas(*window))
        };
        errors.config.has_own_antennas().then(|| Self {
            array,
            is_dipole,
            passes: windows.iter().map(pass).collect(),
        })
    }

    /// The pass of a time, or the nearest one: powers are tabulated beyond a pass's ends.
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

impl AntennaPatterns for AntennaErrors {
    fn antenna(&self, daughter: u8, t_s: f64) -> TiltedAntenna {
        let number = usize::from(daughter);
        let errors = self.pass(t_s).and_then(|daughters| daughters.get(number));
        let [along_deg, radial_deg, distortion] =
            errors.map_or([0.0; 3], |errors| errors.each_ref().map(|series| series.at(t_s)));
        let (r_m, normal_hat) = (self.array.position_m(number, t_s), self.array.normal_hat(number, t_s));
        let axis_hat = tilted_axis(r_m, normal_hat, [along_deg, radial_deg]);
        TiltedAntenna { axis_hat, is_dipole: self.is_dipole, distortion }
    }
}

impl PassErrors {
    /// Tilt of a daughter's antenna along the track and away from the Moon, deg, and the distortion of its pattern.
    #[must_use]
    pub fn antenna(&self, daughter: usize, t_s: f64) -> [f64; 3] {
        self.antennas[daughter].each_ref().map(|series| series.at(t_s))
    }
}
