//! Light curves and dynamic spectra of bursts.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use super::error::{ProductsError, write_product};
use super::pictures::{Axis, ColourScale, Palette, Raster, Scaling, draw_rasters};
use crate::calibration::{BurstEvent, FluxPoint};

/// Columns of a picture.
const COLUMNS: usize = 512;

/// Writes the light curves of all channels as `event-0001.csv` and so on and the dynamic spectrum as `event-0001.png`; nothing without light curves.
///
/// # Errors
/// Files that cannot be written.
pub fn write_event(out: &Path, number: usize, event: &BurstEvent) -> Result<(), ProductsError> {
    if event.curves.iter().all(|curve| curve.points.is_empty()) {
        remove_event(out, number);
        return Ok(());
    }
    let path = |ending: &str| event_file(out, number, ending);
    write_product(&path("csv"), csv(event))?;
    let from_s = event.from_s;
    let title = format!("Event {number}, from {from_s:.0} s");
    let values = raster(event);
    let rows = values.len() / COLUMNS;
    let raster = Raster {
        title: String::new(),
        x: Axis {
            label: format!("s after {from_s:.0} s"),
            limits: Some((0.0, event.until_s - from_s)),
            ..Axis::default()
        },
        y: Axis {
            label: format!("channels with data, {}", band(event)),
            limits: Some((-0.5, rows as f64 - 0.5)),
            ..Axis::default()
        },
        values: &values,
        columns: COLUMNS,
        scale: ColourScale::robust(&values, Scaling::Log, Palette::Inferno),
        unit: "Jy".to_owned(),
    };
    Ok(draw_rasters(&title, &[raster], 1)?.write(&path("png"))?)
}

fn event_file(out: &Path, number: usize, ending: &str) -> PathBuf {
    out.join(format!("event-{number:04}.{ending}"))
}

/// Removes the files of an event of an earlier command.
pub fn remove_event(out: &Path, number: usize) {
    for ending in ["csv", "png"] {
        let _ = fs::remove_file(event_file(out, number, ending));
    }
}

fn band(event: &BurstEvent) -> String {
    let ends = event.curves.first().zip(event.curves.last());
    let mhz = |hz: f64| format!("{:.4}", 1e-6 * hz).trim_end_matches('0').trim_end_matches('.').to_owned();
    ends.map_or_else(String::new, |(first, last)| match event.curves.len() {
        1 => format!("{} MHz", mhz(first.frequency_hz)),
        _ => format!("{} to {} MHz", mhz(first.frequency_hz), mhz(last.frequency_hz)),
    })
}

/// One line for each channel and cell.
fn csv(event: &BurstEvent) -> String {
    let mut text = "channel,frequency_hz,found,from_s,until_s,flux_jy,error_jy\n".to_owned();
    for curve in &event.curves {
        for FluxPoint { from_s, until_s, flux_jy, sigma_jy } in &curve.points {
            let (found, hz) = (u8::from(curve.is_found), curve.frequency_hz);
            // Writing to a string cannot fail.
            let _ = writeln!(
                text,
                "{},{hz},{found},{from_s:.3},{until_s:.3},{flux_jy:.6e},{sigma_jy:.3e}",
                curve.channel
            );
        }
    }
    text
}

/// Flux densities by channel and time; NaN where there are none, and where they are below their errors.
fn raster(event: &BurstEvent) -> Vec<f64> {
    let step_s = (event.until_s - event.from_s) / COLUMNS as f64;
    let mut values = Vec::with_capacity(COLUMNS * event.curves.len());
    for curve in &event.curves {
        let mut points = curve.points.iter().peekable();
        values.extend((0..COLUMNS).map(|column| {
            let t_s = event.from_s + step_s * (column as f64 + 0.5);
            while points.next_if(|point| point.until_s <= t_s).is_some() {}
            let here = points.peek().filter(|point| point.from_s <= t_s && point.flux_jy > point.sigma_jy);
            here.map_or(f64::NAN, |point| point.flux_jy)
        }));
    }
    values
}
