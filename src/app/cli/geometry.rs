//! `lunarray geometry`: positions and baselines.

use clap::Args;
use serde::Serialize;

use super::arguments::{ArrayArgs, TimeOfMission, band_text, frequency_hz, time_of_mission};
use super::output::{
    CommandResult, Completion, print_config_notes, print_json_line, print_notes, print_text,
};
use crate::array::{Array, integration_time_s};
use crate::mother::BAND_HZ;
use crate::units::time_scales::utc_text;
use crate::units::vector::{Vec3, norm, sub};
use crate::units::{Dimension, all_pairs};

/// Print satellite positions, whether the array observes, and the integration time of each pair.
///
/// Positions are Moon-centred on ecliptic axes (x to ecliptic longitude 0, z to the north ecliptic pole), m. The baseline of a
/// pair is r_i - r_j. The array observes while the Moon hides the Earth. Orbits of files have dates, and the Earth and the Sun
/// are where they are then; other missions have an idealised Earth on a circle in the ecliptic. A time outside the orbits is an
/// error.
///
/// Example: lunarray geometry --at 0 12h 7d --freq-hz 3e6
#[derive(Debug, Args)]
pub(super) struct GeometryArgs {
    /// Times since the mission epoch, numbers with an optional unit s, h or d, such as 7d; or dates: TAI such as
    /// 2027-01-08T12:00:00, or UTC such as 2027-01-08T12:00:00Z.
    #[arg(long = "at", value_name = "TIME", num_args = 1.., required = true, allow_negative_numbers = true, value_parser = time_of_mission)]
    at: Vec<TimeOfMission>,
    /// Frequency for the integration times, Hz, or with a unit, such as 3MHz.
    #[arg(long, default_value = "10MHz", value_parser = frequency_hz)]
    freq_hz: f64,
    /// Print one JSON object per line: t_s, observing, earth_hat, sun_hat (null where the mission is
    /// idealised), utc, satellites_m, pairs.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    array: ArrayArgs,
}

#[derive(Serialize)]
struct GeometryReport {
    t_s: f64,
    observing: bool,
    earth_hat: Vec3,
    sun_hat: Option<Vec3>,
    utc: String,
    satellites_m: Vec<Vec3>,
    pairs: Vec<PairReport>,
}

#[derive(Serialize)]
struct PairReport {
    pair: String,
    baseline_m: Vec3,
    length_m: f64,
    dt_s: f64,
}

pub(super) fn execute(args: &GeometryArgs) -> CommandResult {
    if !(BAND_HZ[0]..=BAND_HZ[1]).contains(&args.freq_hz) {
        return Err(format!(
            "--freq-hz {}: expected {}",
            Dimension::Frequency.show(args.freq_hz),
            band_text(BAND_HZ)
        )
        .into());
    }
    let config = args.array.source().load()?;
    print_config_notes(&config);
    let array = Array::new(&config.array)?;
    print_notes(array.notes());
    let epoch_tai_s = config.epoch_tai_s(&array);
    for time in &args.at {
        let t_s = time.since_s(epoch_tai_s);
        array.require_known(t_s)?;
        let rule = config.spacecraft.rule();
        let states: Vec<_> = (0..array.satellites()).map(|n| array.state(n, t_s)).collect();
        let pairs = all_pairs(array.satellites()).into_iter().map(|pair| {
            let (i, j) = (states[usize::from(pair.i)], states[usize::from(pair.j)]);
            let baseline_m = sub(i.position_m, j.position_m);
            PairReport {
                pair: pair.to_string(),
                baseline_m,
                length_m: norm(baseline_m),
                dt_s: integration_time_s(rule, args.freq_hz, i.velocity_m_s, j.velocity_m_s),
            }
        });
        let geometry = GeometryReport {
            t_s,
            observing: array.observing(t_s),
            earth_hat: array.earth_hat(t_s),
            sun_hat: array.sun_hat(t_s),
            utc: utc_text(epoch_tai_s + t_s),
            satellites_m: states.iter().map(|state| state.position_m).collect(),
            pairs: pairs.collect(),
        };
        if args.json {
            print_json_line(&geometry)?;
        } else {
            print_text(&table(&geometry))?;
        }
    }
    Ok(Completion::Done)
}

fn table(geometry: &GeometryReport) -> String {
    use std::fmt::Write;
    let mut text = String::new();
    let state = if geometry.observing { "observing (Earth hidden)" } else { "Earth in sight" };
    let [x, y, z] = geometry.earth_hat;
    // Writing to a String cannot fail.
    let _ = writeln!(
        text,
        "t = {} s, {} UTC: {state}; Earth towards ({x:.6}, {y:.6}, {z:.6})",
        geometry.t_s, geometry.utc
    );
    let _ = match geometry.sun_hat {
        Some([x, y, z]) => writeln!(text, "  Sun towards ({x:.6}, {y:.6}, {z:.6})"),
        None => writeln!(text, "  an idealised Earth, on a circle in the ecliptic"),
    };
    for (n, [x, y, z]) in geometry.satellites_m.iter().enumerate() {
        let _ = writeln!(text, "  daughter {}  {x:>14.3} {y:>14.3} {z:>14.3} m", n + 1);
    }
    let _ = writeln!(text, "  pair      length (m)         dt (s)");
    for pair in &geometry.pairs {
        let _ = writeln!(text, "  {:<6} {:>13.3} {:>14.6}", pair.pair, pair.length_m, pair.dt_s);
    }
    text.trim_end().to_owned()
}
