//! Table of the true errors.

use std::fmt::Write;

use super::InstrumentErrors;
use crate::frames::ObservingWindow;

/// Comma-separated values, one line for each pass, instant (its middle; also start and end if errors change within a
/// pass), daughter and channel: the natural logarithm of the gain's amplitude, its phase (deg, -180 to 180, clock
/// included, as in tables of solutions), the clock (ns), the error of the position (m, along, across and away from
/// the Moon), 1 for a dead receiver, the tilt of the antenna (deg, along the track and away from the Moon), the
/// distortion of its pattern, the error of the time tags (ms), and the phase without the clock (deg:
/// `instrument.phase_deg`).
#[must_use]
pub fn truth_csv(errors: &InstrumentErrors, windows: &[ObservingWindow]) -> String {
    let mut text = String::from(
        "pass,time_s,daughter,channel,frequency_hz,ln_amplitude,phase_deg,clock_ns,along_m,across_m,radial_m,dead,\
         tilt_along_deg,tilt_radial_deg,pattern,time_tag_ms,phase_without_clock_deg\n",
    );
    for window in windows {
        let pass = errors.pass(*window);
        let (start_s, end_s) = (window.start.seconds(), window.end.seconds());
        let instants = [0.5 * (start_s + end_s), start_s, end_s];
        let count = if errors.changes_in_a_pass() { 3 } else { 1 };
        for t_s in instants.into_iter().take(count) {
            let time_tag_ms = 1e3 * pass.time_tag_s(t_s);
            for daughter in 0..errors.satellites {
                let [along, across, radial] = pass.offset_m(daughter, t_s);
                let [tilt_along, tilt_radial, pattern] = pass.antenna(daughter, t_s);
                let clock_ns = pass.clock_ns[daughter].at(t_s);
                for (channel, of) in errors.channels.iter().enumerate() {
                    let without_clock_deg = pass.phase_deg[daughter][channel].at(t_s);
                    let turned_deg = without_clock_deg - 360.0 * of.frequency_hz * 1e-9 * clock_ns;
                    let phase_deg = (turned_deg + 180.0).rem_euclid(360.0) - 180.0;
                    // Writing to a String cannot fail.
                    let _ = writeln!(
                        text,
                        "{},{t_s:.6},{},{},{},{:.9},{phase_deg:.7},{clock_ns:.7},{along:.6},{across:.6},{radial:.6},{},\
                         {tilt_along:.7},{tilt_radial:.7},{pattern:.9},{time_tag_ms:.6},{without_clock_deg:.7}",
                        window.index,
                        daughter + 1,
                        channel,
                        of.frequency_hz,
                        pass.amplitude[daughter][channel].at(t_s),
                        u8::from(pass.is_dead(daughter, channel)),
                    );
                }
            }
        }
    }
    text
}
