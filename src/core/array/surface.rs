//! Stations that turn with the Moon.

use std::path::Path;

use super::bodies::{MoonAxes, Orientation};
use super::config::ArrayError;
use super::state::SatelliteState;
use super::stations::{Station, Stations};
use crate::files::{Columns, Separator, TableFault, numbered_lines, read_file, text_of};
use crate::units::constants::MOON_RELIEF_M;
use crate::units::time_scales::Tai;
use crate::units::vector::{Vec3, cross, direction, norm, scale, unit};
use crate::units::{Checks, MAX_SATELLITES};

/// Largest file of stations that is read, bytes.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// The stations' motion from `epoch` on, on a Moon of this radius.
pub(super) fn motions(
    stations: &Stations,
    satellites: usize,
    epoch: Tai,
    moon_radius_m: f64,
) -> Result<Vec<StationMotion>, ArrayError> {
    let stations = match stations {
        Stations::List(stations) => stations.clone(),
        Stations::File(path) => read(path, satellites)?,
    };
    let heights = stations.iter().map(|station| station.height_m);
    let (low, high) = heights.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), m| (m.min(a), m.max(b)));
    let mut checks = Checks::new("array");
    let expected =
        format!("heights that differ by less than {MOON_RELIEF_M} m: each station has a flat horizon");
    checks.require(
        "stations",
        format_args!("({low} m to {high} m high)"),
        high - low < MOON_RELIEF_M,
        expected,
    );
    if let Some(problem) = checks.finish().into_iter().next() {
        return Err(problem.into());
    }
    let motion = |station: &Station| {
        let up = direction(station.longitude_deg, station.latitude_deg);
        StationMotion { epoch, fixed_m: scale(moon_radius_m + station.height_m, up) }
    };
    Ok(stations.iter().map(motion).collect())
}

/// Reads a file of stations.
fn read(path: &Path, satellites: usize) -> Result<Vec<Station>, ArrayError> {
    let error = |what: String| ArrayError::File { path: path.to_owned(), what };
    let bytes = read_file(path, FILE_BYTES_MAX).map_err(|source| error(source.to_string()))?;
    let text =
        text_of(&bytes).map_err(|form| error(format!("{form}; expected a table as plain text (CSV)")))?;
    let of_table = |fault: TableFault| error(fault.to_string());
    let mut lines = numbered_lines(&text);
    let (number, names) = lines.next().unwrap_or((1, ""));
    let columns = Columns::new(number, names, Separator::Sign(',')).map_err(of_table)?;
    let expected = "longitude_deg, latitude_deg, and height_m if they are not all 0";
    let [longitude, latitude] =
        columns.places(["longitude_deg", "latitude_deg"], expected).map_err(of_table)?;
    let height = columns.place("height_m").map_err(of_table)?;
    let mut stations = Vec::new();
    for (number, line) in lines {
        let row = columns.row(number, line).map_err(of_table)?;
        let value = |place| row.number(place, |_| true, "a number").map_err(of_table);
        let station = Station {
            longitude_deg: value(longitude)?,
            latitude_deg: value(latitude)?,
            height_m: height.map_or(Ok(0.0), value)?,
        };
        let mut checks = Checks::new("");
        station.check("", &mut checks);
        if let Some(problem) = checks.finish().into_iter().next() {
            return Err(error(format!("line {number}: {problem}")));
        }
        stations.push(station);
    }
    if stations.len() != satellites {
        return Err(error(format!(
            "{} stations; expected as many as array.satellites, {satellites}, at most {MAX_SATELLITES}: the limit of the \
             downlink's format",
            stations.len()
        )));
    }
    Ok(stations)
}

/// Motion of a station with the Moon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct StationMotion {
    epoch: Tai,
    /// Position on the Moon's mean Earth and polar axes, m.
    fixed_m: Vec3,
}

impl StationMotion {
    pub(super) fn state(&self, t_s: f64) -> SatelliteState {
        let fixed = SatelliteState { position_m: self.fixed_m, velocity_m_s: [0.0; 3] };
        Orientation::at(self.epoch.plus_s(t_s)).state(MoonAxes::MeanEarth, fixed)
    }

    /// North: the normal of the plane in which it moves at a time.
    pub(super) fn north_hat(&self, t_s: f64) -> Vec3 {
        let state = self.state(t_s);
        unit(cross(state.position_m, state.velocity_m_s))
    }

    /// Distance from the Moon's centre, m.
    pub(super) fn radius_m(&self) -> f64 {
        norm(self.fixed_m)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig, ObservingWindows};
    use crate::units::constants::DAY_S;
    use crate::units::vector::{dot, sub};

    fn station(longitude_deg: f64, latitude_deg: f64, height_m: f64) -> Station {
        Station { longitude_deg, latitude_deg, height_m }
    }

    fn config(stations: Vec<Station>, epoch: &str) -> ArrayConfig {
        ArrayConfig {
            satellites: stations.len(),
            stations: Stations::List(stations),
            stations_epoch: epoch.into(),
            ..ArrayConfig::default()
        }
    }

    fn far_side(epoch: &str) -> ArrayConfig {
        config(
            vec![station(170.0, -30.0, 0.0), station(170.004, -30.0, 12.0), station(170.0, -29.994, -4.0)],
            epoch,
        )
    }

    #[test]
    fn stations_are_where_other_code_has_them() {
        // Station 1 on ECLIPJ2000, m: NAIF's toolkit with JPL's DE421, as in `bodies/orientation.rs`.
        for (epoch, expected) in [
            ("2030-01-01T00:00:00", [-1_023_766.1, -1_120_500.5, -844_924.9]),
            ("2030-01-09T12:00:00Z", [1_392_007.3, -505_018.2, -908_178.7]),
            ("2039-06-01T00:00:00", [-1_451_160.5, 293_868.3, -908_455.3]),
        ] {
            let array = Array::new(&far_side(epoch)).unwrap();
            let off_m = norm(sub(array.position_m(0, 0.0), expected));
            // 0.005 degrees of 1737.1 km.
            assert!(off_m < 152.0, "{epoch}: {off_m} m");
            // Chords of 0.004 deg of longitude at 30 deg of latitude and 12 m of height, and of 0.006 deg of latitude and 4 m.
            for (other, expected_m) in [(1, 105.708_72), (2, 181.952_45)] {
                let baseline_m = norm(sub(array.position_m(0, 1e5), array.position_m(other, 1e5)));
                // Roundings of 1e6 m.
                assert!((baseline_m - expected_m).abs() < 1e-5, "{baseline_m}");
            }
            // The Moon below is that of the highest station.
            assert!((array.moon_radius_m() - 1_737_112.0).abs() < 1e-9 && array.is_on_surface());
            // North is across the vertical, and 1.54 degrees at most from where the ecliptic's pole is seen.
            let [up, north] = [unit(array.position_m(0, 0.0)), array.normal_hat(0, 0.0)];
            assert!(dot(up, north).abs() < 1e-12 && (north[2] - 30.0_f64.to_radians().cos()).abs() < 0.03);
        }
    }

    #[test]
    fn windows_fill_the_time_in_which_the_earth_is_below_the_horizon() {
        let array = Array::new(&far_side("2030-01-01T00:00:00")).unwrap();
        let windows: Vec<_> = ObservingWindows::new(&array, 0.0, 10_000.0).collect();
        let ends: Vec<[f64; 2]> =
            windows.iter().map(|window| [window.start.seconds(), window.end.seconds()]).collect();
        assert_eq!(ends, [[0.0, 3600.0], [3600.0, 7200.0], [7200.0, 10_000.0]]);
        // Where the Earth is at the zenith it never sets; at the limb it does by libration, of up to 8 degrees, in a month.
        let count = |longitude_deg: f64| {
            let places = [0.0, 0.01, 0.03].map(|off| station(longitude_deg + off, 0.0, 0.0));
            let array = Array::new(&config(places.to_vec(), "2030-01-01T00:00:00")).unwrap();
            let windows: Vec<_> = ObservingWindows::new(&array, 0.0, 28.0 * DAY_S).collect();
            for window in &windows {
                for t_s in [window.start.seconds() + 1.0, window.end.seconds() - 1.0] {
                    let elevation = dot(unit(array.position_m(0, t_s)), array.earth_hat(t_s));
                    assert!(elevation < 0.0, "{longitude_deg} {t_s}: {elevation}");
                }
            }
            windows.len()
        };
        assert_eq!((count(0.0), count(180.0)), (0, 28 * 24));
        assert!((28 * 6..28 * 18).contains(&count(90.0)));
    }

    #[test]
    fn a_file_has_what_a_list_has_and_faults_are_told() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("stations.csv");
        let of_file = |text: &str| {
            std::fs::write(&path, text).unwrap();
            let file = ArrayConfig {
                satellites: 3,
                stations: Stations::File(path.clone()),
                stations_epoch: "2030-01-01T00:00:00".into(),
                ..ArrayConfig::default()
            };
            Array::new(&file)
        };
        let text = "# South of Ingenii\nlatitude_deg, longitude_deg, height_m\n-30,170,0\n-30,170.004,12\n-29.994,170,-4\n";
        assert_eq!(of_file(text).unwrap(), Array::new(&far_side("2030-01-01T00:00:00")).unwrap());
        // As spreadsheets leave it: a mark, quotes, other line ends, empty cells.
        let text = "\u{feff}\"longitude_deg\",latitude_deg,height_m,name,\r\n170,-30,0,\"A, B\",\r\n170.004,\"-30\",12,,,,\r\n\
                    170,-29.994,-4\r\n,,,,\r\n";
        assert_eq!(of_file(text).unwrap(), Array::new(&far_side("2030-01-01T00:00:00")).unwrap());
        for (text, told) in [
            ("longitude_deg,latitude_deg\n1,2\n3,4,5\n", "line 3: found 3 cells; expected 2"),
            ("longitude_deg,latitude_deg\n1,\"2\n3,4\n5,6\n", "line 2: found a quote that is not closed"),
            (
                "longitude_deg,latitude_deg,Height (m)\n1,2,3\n",
                "\"Height (m)\"; expected its values as height_m",
            ),
            ("lat,lon\n1,2\n", "found the columns \"lat, lon\""),
            ("longitude_deg,latitude_deg\n1,2\n3,x\n", "line 3: found \"x\" as latitude_deg"),
            (
                "longitude_deg,latitude_deg,height_km\n1,2,3\n",
                "\"height_km\"; expected its values as height_m",
            ),
            ("longitude_deg,latitude_deg\n1,2\n3,95\n", "line 3: latitude_deg = 95"),
            ("longitude_deg,latitude_deg\n1,2\n3,4\n", "2 stations; expected as many as array.satellites, 3"),
            ("longitude_deg,latitude_deg\n1,2\n1,2\n3,4\n", "satellites 1 and 2 are at one place"),
        ] {
            let said = of_file(text).unwrap_err().to_string();
            assert!(said.contains(told), "{said}: expected {told}");
        }
        let many: Vec<Station> = (0..65).map(|n| station(170.0 + 0.01 * f64::from(n), 0.0, 0.0)).collect();
        for (config, told) in [
            (config(many, "2030-01-01T00:00:00"), "3 to 64"),
            (far_side("soon"), "stations_epoch"),
            (
                ArrayConfig { satellites: 4, ..far_side("2030-01-01T00:00:00") },
                "the limit of the downlink's format",
            ),
            (config(vec![station(170.0, 0.0, 1e5); 3], "2030-01-01T00:00:00"), "relief"),
            (
                config(
                    vec![station(170.0, 0.0, -9e3), station(171.0, 0.0, 9e3), station(172.0, 0.0, 0.0)],
                    "2030-01-01T00:00:00",
                ),
                "heights that differ by less than",
            ),
            (ArrayConfig { oem: vec!["a".into(); 3], ..far_side("2030-01-01T00:00:00") }, "array.oem"),
        ] {
            let said: Vec<String> = config.problems().iter().map(ToString::to_string).collect();
            let said =
                if said.is_empty() { Array::new(&config).unwrap_err().to_string() } else { said.join("; ") };
            assert!(said.contains(told), "{said}: expected {told}");
        }
    }
}
