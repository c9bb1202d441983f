//! Downlink files as arrays.

use std::path::PathBuf;
use std::sync::Arc;

use lunarray::downlink::Contents;
use lunarray::imaging::circle::GeometrySurvey;
use lunarray::products::{VisibilityRow, VisibilityTable, jansky_per_k_sr};
use lunarray::response::harmonic::GeometryLimits;
use lunarray::runtime::Cancel;
use lunarray::units::ChannelId;
use lunarray::units::time_scales::tai_minus_utc_s;
use lunarray::units::vector::{Vec3, sub};
use numpy::{PyArray1, PyArray2, PyReadonlyArray1};
use pyo3::prelude::*;
use serde_json::json;

use crate::array::places;
use crate::error::refused;
use crate::wait::{wait, wait_to_read};

/// Nanoseconds from 1958-01-01, where TAI is counted from, to 1970-01-01, where numpy's `datetime64` is.
const FROM_1958_NS: i128 = 4383 * 86_400 * 1_000_000_000;

/// What is in a downlink file, as `lunarray inspect --json` prints it.
#[pyfunction]
pub(crate) fn inspect(py: Python<'_>, path: PathBuf) -> PyResult<String> {
    wait_to_read(py, &Cancel::new(), move || {
        let mut survey = GeometrySurvey::new(GeometryLimits::default());
        let contents = Contents::read_with(&path, &mut |frame| survey.add(frame))?;
        let mut value = serde_json::to_value(&contents)?;
        if let Some(object) = value.as_object_mut() {
            object.insert("geometry".to_owned(), serde_json::to_value(survey.finish())?);
        }
        Ok(value.to_string())
    })
}

/// A downlink file in memory.
#[pyclass(frozen)]
pub(crate) struct NativeDownlink(Arc<VisibilityTable>);

#[pymethods]
impl NativeDownlink {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let cancel = Cancel::new();
        let watched = cancel.clone();
        let table = wait_to_read(py, &cancel, move || Ok(VisibilityTable::read(&path, &watched)?))?;
        Ok(Self(Arc::new(table)))
    }

    /// The instrument as JSON.
    fn instrument(&self) -> String {
        let instrument = self.0.instrument();
        let channels = |of: fn(&lunarray::frames::Channel) -> f64| -> Vec<f64> {
            instrument.channels.iter().map(of).collect()
        };
        json!({
            "name": instrument.name,
            "epoch_tai_s": instrument.epoch_tai_s,
            "moon_radius_m": instrument.moon_radius_m,
            "satellites": instrument.satellites,
            "channels_hz": channels(|channel| channel.frequency_hz),
            "widths_hz": channels(|channel| channel.width_hz),
            "antenna": format!("{:?}", instrument.response),
            "noiseless": instrument.noiseless,
            "seed": instrument.seed,
        })
        .to_string()
    }

    /// Visibilities of a channel, as the bytes of rows of `lunarray._rows.VISIBILITY`.
    fn visibilities<'py>(&self, py: Python<'py>, channel: u16) -> PyResult<Bound<'py, PyArray1<u8>>> {
        let table = Arc::clone(&self.0);
        let Some(found) = table.instrument().channels.get(usize::from(channel)) else {
            let (count, at) = (table.instrument().channels.len(), channel);
            return Err(refused(format!(
                "channel {at}: expected one of the file's {count} channels, from 0"
            )));
        };
        let (frequency_hz, epoch_ns) = (found.frequency_hz, epoch_ns(&table));
        let bytes = wait(py, &Cancel::new(), move || {
            let rows = table.visibilities(ChannelId(channel));
            let mut bytes = Vec::with_capacity(rows.len() * 136);
            for row in &rows {
                put(&mut bytes, row, epoch_ns, frequency_hz);
            }
            Ok(bytes)
        })?;
        Ok(PyArray1::from_vec(py, bytes))
    }

    /// Auto-correlations of all channels, likewise; and the frequency of each.
    fn autos<'py>(&self, py: Python<'py>) -> PyResult<AutoArrays<'py>> {
        let table = Arc::clone(&self.0);
        let epoch_ns = epoch_ns(&table);
        let (bytes, frequencies_hz) = wait(py, &Cancel::new(), move || {
            let (mut bytes, mut frequencies_hz) = (Vec::new(), Vec::new());
            for (channel, row) in table.autos() {
                let found = table.instrument().channel_of(channel, row.pair);
                let frequency_hz = found.map_or(f64::NAN, |channel| channel.frequency_hz);
                put(&mut bytes, &row, epoch_ns, frequency_hz);
                frequencies_hz.push(frequency_hz);
            }
            Ok((bytes, frequencies_hz))
        })?;
        Ok((PyArray1::from_vec(py, bytes), PyArray1::from_vec(py, frequencies_hz)))
    }

    /// Positions of all satellites at times, m: a row a time, three columns a satellite; NaN where unknown.
    fn positions<'py>(
        &self,
        py: Python<'py>,
        times_s: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let ephemeris = self.0.ephemeris();
        places(py, &times_s, self.0.instrument().satellites.into(), |t_s, n| ephemeris.position_at(t_s, n))
    }
}

type AutoArrays<'py> = (Bound<'py, PyArray1<u8>>, Bound<'py, PyArray1<f64>>);

fn epoch_ns(table: &VisibilityTable) -> i128 {
    let epoch_s = table.instrument().epoch_tai_s;
    // Whole seconds apart, so that nothing is rounded but the fraction.
    (epoch_s.trunc() as i128) * 1_000_000_000 + (epoch_s.fract() * 1e9).round() as i128 - FROM_1958_NS
}

/// Appends a row; its layout is `VISIBILITY` in `lunarray/_rows.py`.
fn put(bytes: &mut Vec<u8>, row: &VisibilityRow, epoch_ns: i128, frequency_hz: f64) {
    let tai_ns = (epoch_ns + i128::from(row.middle_half_us) * 500) as i64;
    let [r_i_m, r_j_m]: [Vec3; 2] = row.positions_m.unwrap_or([[f64::NAN; 3]; 2]);
    let jansky_per_k_sr = jansky_per_k_sr(frequency_hz);
    bytes.extend((row.middle_half_us as f64 * 0.5e-6).to_ne_bytes());
    bytes.extend(tai_ns.to_ne_bytes());
    // `datetime64` has no second 60: a leap second is that of the next midnight.
    let behind_ns = tai_minus_utc_s(tai_ns.div_euclid(1_000_000_000)) * 1_000_000_000;
    bytes.extend(tai_ns.saturating_sub(behind_ns).to_ne_bytes());
    bytes.extend((f64::from(row.duration_us) * 1e-6).to_ne_bytes());
    bytes.extend([row.pair.i + 1, row.pair.j + 1, row.flags.0, 0]);
    bytes.extend(row.weight.to_ne_bytes());
    for value in [sub(r_i_m, r_j_m), r_i_m, r_j_m].into_iter().flatten() {
        bytes.extend(value.to_ne_bytes());
    }
    let value = row.value_k_sr;
    bytes.extend(value.re.to_ne_bytes());
    bytes.extend(value.im.to_ne_bytes());
    bytes.extend((f64::from(value.re) * jansky_per_k_sr).to_ne_bytes());
    bytes.extend((f64::from(value.im) * jansky_per_k_sr).to_ne_bytes());
}
