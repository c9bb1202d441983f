//! `lunarray predict`: predict single visibilities.

use std::io::BufRead;
use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::arguments::{ArrayArgs, MapFileArgs, TimeOfMission, band_text, frequency_hz, time_of_mission};
use super::lines::next_line;
use super::output::{CommandError, CommandResult, Completion, print_json_line, print_notes, print_text};
use crate::array::Array;
use crate::files::{Columns, Row, Separator, TableFault, without_cells, without_mark};
use crate::mother::BAND_HZ;
use crate::response::pixel::{PairGeometry, exact};
use crate::sky::fits::{MapFile, ReadOptions, check_frequency, read_notes, read_whole_map_file};
use crate::sky::healpix::pixel_area_sr;
use crate::units::{Dimension, MAX_SATELLITES, Pair, echo};

/// Predict visibilities of a sky map by a direct sum over its pixels.
///
/// V_ij = sum over pixels of T A S_i S_j exp(-2 pi i (nu/c) n . (r_i - r_j)) dOmega, K sr, in double precision. A pixel
/// is evaluated at its centre, and counts if the Moon does not hide its centre. A map in Galactic or equatorial
/// coordinates is not resampled; its pixel centres are rotated.
///
/// Without --at, reads rows from standard input: CSV with the columns t_s, i, j, freq_hz.
///
/// Example: lunarray predict --sky sky.fits --at 2h --pair 1-2 --freq-hz 10e6
#[derive(Debug, Args)]
pub(super) struct PredictArgs {
    /// HEALPix map, K (FITS), of the frequency of the visibilities if it states one.
    #[arg(long, value_name = "MAP.fits")]
    sky: PathBuf,
    #[command(flatten)]
    maps: MapFileArgs,
    /// Frequency, Hz, or with a unit, such as 3MHz.
    #[arg(long, requires = "at", value_parser = frequency_hz)]
    freq_hz: Option<f64>,
    /// Time since the mission epoch, a number with an optional unit s, h or d, such as 7d; or a date: TAI such as
    /// 2027-01-08T12:00:00, or UTC such as 2027-01-08T12:00:00Z.
    #[arg(long, value_name = "TIME", requires_all = ["freq_hz", "pair"], value_parser = time_of_mission)]
    at: Option<TimeOfMission>,
    /// Pair of satellites, such as 1-2.
    #[arg(long, requires = "at")]
    pair: Option<Pair>,
    /// Print one JSON object per line: t_s, i, j, freq_hz, re, im (K sr).
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    array: ArrayArgs,
}

/// Columns of standard input.
const COLUMNS: [&str; 4] = ["t_s", "i", "j", "freq_hz"];

#[derive(Clone, Copy)]
struct VisibilityQuery {
    t_s: f64,
    pair: Pair,
    freq_hz: f64,
}

#[derive(Serialize)]
struct Prediction {
    t_s: f64,
    i: u32,
    j: u32,
    freq_hz: f64,
    re: f64,
    im: f64,
}

pub(super) fn execute(args: &PredictArgs) -> CommandResult {
    let config = args.array.source().load()?;
    let array = Array::new(&config.array)?;
    let options = ReadOptions { frequency_hz: args.freq_hz, ..args.maps.options() };
    let MapFile { map, frequency_hz: map_hz, .. } = read_whole_map_file(&args.sky, &options)?;
    if let (None, Some(freq_hz)) = (map_hz, args.freq_hz) {
        // What other texts of its header say.
        check_frequency(&args.sky, freq_hz, &options)?;
    }
    print_notes(read_notes(&args.sky, &options)?);
    let directions = map.directions_ecliptic();
    let area_sr = pixel_area_sr(map.nside());
    let print_prediction = |query: VisibilityQuery| -> Result<(), CommandError> {
        check(&array, query)?;
        let VisibilityQuery { t_s, pair, freq_hz } = query;
        args.require_frequency(map_hz, freq_hz)?;
        let geometry = PairGeometry {
            r_i_m: array.position_m(pair.i.into(), t_s),
            r_j_m: array.position_m(pair.j.into(), t_s),
            frequency_hz: freq_hz,
            moon_radius_m: array.moon_radius_m(),
            response: config.spacecraft.antenna.into(),
        };
        let value = exact::visibility(&geometry, &directions, map.values(), area_sr).visibility_k_sr;
        let (i, j) = (u32::from(pair.i) + 1, u32::from(pair.j) + 1);
        if args.json {
            return print_json_line(&Prediction { t_s, i, j, freq_hz, re: value.re, im: value.im });
        }
        print_text(&format!(
            "t = {t_s} s, pair {pair}, {}: {:+.9e} {:+.9e} i K sr",
            Dimension::Frequency.show(freq_hz),
            value.re,
            value.im
        ))
    };
    if let (Some(time), Some(pair), Some(freq_hz)) = (args.at, args.pair, args.freq_hz) {
        let t_s = time.since_s(config.epoch_tai_s(&array));
        print_prediction(VisibilityQuery { t_s, pair, freq_hz })?;
        return Ok(Completion::Done);
    }
    each_row(&mut std::io::stdin().lock(), |number, query| {
        check(&array, query).map_err(|error| format!("standard input, line {number}: {error}"))?;
        print_prediction(query)
    })?;
    Ok(Completion::Done)
}

/// Hands on the number and the visibility of each row of a table, as it comes.
fn each_row(
    input: &mut impl BufRead,
    mut answer: impl FnMut(usize, VisibilityQuery) -> Result<(), CommandError>,
) -> Result<(), CommandError> {
    let of_input = |fault: TableFault| format!("standard input, {fault}");
    let header = |number, names: &str| {
        let columns = Columns::new(number, names, Separator::Sign(','))?;
        let places = columns.places(COLUMNS, "t_s,i,j,freq_hz")?;
        Ok((columns, places))
    };
    let mut table = None;
    for number in 1.. {
        let Some(line) = next_line(input, number)? else { break };
        let line = if number == 1 { without_mark(&line) } else { &line };
        if without_cells(line) {
            continue;
        }
        let Some((columns, places)) = &table else {
            table = Some(header(number, line).map_err(of_input)?);
            continue;
        };
        let query = columns.row(number, line).and_then(|row| query(&row, *places));
        answer(number, query.map_err(of_input)?)?;
    }
    if table.is_none() {
        header(1, "").map_err(of_input)?;
    }
    Ok(())
}

impl PredictArgs {
    /// Requires that the map is of the frequency of a visibility, if it states one.
    fn require_frequency(&self, map_hz: Option<f64>, freq_hz: f64) -> Result<(), String> {
        let Some(map_hz) = map_hz.filter(|map_hz| (map_hz - freq_hz).abs() > 1e-6 * freq_hz) else {
            return Ok(());
        };
        let [found, wanted] = [map_hz, freq_hz].map(|hz| Dimension::Frequency.show(hz));
        Err(format!(
            "freq_hz = {wanted}: expected {found}, the frequency of {}, as its header says",
            self.sky.display()
        ))
    }
}

fn query(row: &Row<'_>, [t_s, i, j, freq_hz]: [usize; 4]) -> Result<VisibilityQuery, TableFault> {
    let number = |place| row.number(place, |_| true, "a number");
    let satellite = |place| row.cell(place).parse().map_err(|_| row.fault(place, "a satellite's number"));
    let [one, other] = [satellite(i)?, satellite(j)?];
    let expected = || format!("1 <= i < j <= {MAX_SATELLITES}");
    let pair = Pair::from_one_based(one, other)
        .map_err(|_| row.fault_of(format!("i = {one}, j = {other}"), &expected()))?;
    Ok(VisibilityQuery { t_s: number(t_s)?, pair, freq_hz: number(freq_hz)? })
}

fn check(array: &Array, query: VisibilityQuery) -> Result<(), String> {
    let VisibilityQuery { t_s, pair, freq_hz } = query;
    if !(-1e9..=1e9).contains(&t_s) {
        return Err(format!("t_s = {}: expected seconds, -1e9 to 1e9", echo(t_s)));
    }
    array.require_known(t_s).map_err(|error| error.to_string())?;
    if usize::from(pair.j) >= array.satellites() {
        return Err(format!("pair {pair}: the array has {} satellites", array.satellites()));
    }
    if !(BAND_HZ[0]..=BAND_HZ[1]).contains(&freq_hz) {
        let found = Dimension::Frequency.show(freq_hz);
        return Err(format!("freq_hz = {found}: expected {}", band_text(BAND_HZ)));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(text: &str) -> Result<Vec<(usize, f64, String, f64)>, String> {
        let mut found = Vec::new();
        let read = each_row(&mut text.as_bytes(), |number, query| {
            found.push((number, query.t_s, query.pair.to_string(), query.freq_hz));
            Ok(())
        });
        read.map(|()| found).map_err(|error| error.to_string())
    }

    #[test]
    fn rows_are_of_columns_by_name_and_faults_are_told() {
        let text = "\u{feff}# pairs\r\n\r\nfreq_hz,j,note,i,t_s\r\n3e6,2,\"a, b\",1,5\r\n# later\r\n,,,,\r\n1e7,3,,2,-6\r\n";
        assert_eq!(rows(text), Ok(vec![(4, 5.0, "1-2".into(), 3e6), (7, -6.0, "2-3".into(), 1e7)]));
        assert_eq!(rows("\u{feff}t_s,i,j,freq_hz\n"), Ok(vec![]));
        for (text, told) in [
            ("", "standard input, line 1: found the columns \"\"; expected t_s,i,j,freq_hz"),
            (
                "t_s,i,j,freq_hz\n0,0,2,3e6\n",
                "standard input, line 2: found i = 0, j = 2; expected 1 <= i < j <= 64",
            ),
            (
                "t_s,i,j,freq_hz\n\n0,3,3,3e6\n",
                "standard input, line 3: found i = 3, j = 3; expected 1 <= i < j <= 64",
            ),
            (
                "t_s,i,j,freq_hz\n0,x,2,3e6\n",
                "standard input, line 2: found \"x\" as i; expected a satellite's number",
            ),
            (
                "t_s,i,j,freq_mhz\n0,1,2,3\n",
                "standard input, line 1: found the column \"freq_mhz\"; \
                 expected its values as freq_hz, or another name if they mean something else",
            ),
        ] {
            assert_eq!(rows(text), Err(told.to_owned()), "{text}");
        }
    }
}
