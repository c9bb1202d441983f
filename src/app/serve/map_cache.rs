//! Bounded cache of maps for the server: the last map of each channel, and a thinned selection of earlier ones.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::SystemTime;

use axum::body::Bytes;
use serde::Serialize;

use super::screen_text::group_digits;
use crate::imaging::Diagnostics;
use crate::products::pictures::{ColourScale, MapPanel, Palette, Sampling, Scaling, Sheet, View, draw_sheet};
use crate::products::{PublishedMap, SnapshotSummary};
use crate::sky::fits::{Card, WriteOptions, map_bytes};
use crate::sky::harmonics::AnalysisOptions;
use crate::sky::spectra::auto_cl;
use crate::sky::{Comparison, Frame, MapError, SkyMap};
use crate::units::ChannelId;

const MAPS_MAX: usize = 32;

/// Maximum size of all maps before the last of each channel, bytes.
const EARLIER_BYTES_MAX: usize = 64 << 20;

/// Maximum number of snapshots of a channel whose figures are held.
const FIGURES_MAX: usize = 512;

/// Maximum nside of a map whose spectrum is computed here, if there is no input sky, so that the publisher has not computed it.
const SPECTRUM_NSIDE_MAX: usize = 64;

/// Angular power spectra of a map and of its noise, K^2, and the map's correlation with the input.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct SpectraOfMap {
    cl_map: Vec<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cl_truth: Option<Vec<f64>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cl_noise: Option<Vec<f64>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rho: Option<Vec<f64>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rho_noise_subtracted: Option<Vec<f64>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    snr: Option<Vec<f64>>,
}

impl From<&Comparison> for SpectraOfMap {
    fn from(comparison: &Comparison) -> Self {
        Self {
            cl_map: comparison.cl_map.clone(),
            cl_truth: Some(comparison.cl_truth.clone()),
            cl_noise: comparison.cl_noise.clone(),
            rho: Some(comparison.rho.clone()),
            rho_noise_subtracted: comparison.rho_noise_subtracted.clone(),
            snr: comparison.snr.clone(),
        }
    }
}

/// A map that can be served.
#[derive(Debug)]
pub(super) struct ShownMap {
    /// Pixels in RING order and ecliptic coordinates, K: little-endian 32-bit floats, as in its file.
    pub(super) pixels: Bytes,
    /// Header cards of the map's file; `None` for maps whose files are written at the end.
    cards: Option<Vec<Card>>,
    title: String,
    unit: &'static str,
    /// The picture, drawn on the first request.
    picture: OnceLock<Bytes>,
}

impl ShownMap {
    fn new(values: &[f64], cards: Option<Vec<Card>>, title: String, unit: &'static str) -> Self {
        let pixels: Vec<u8> = values.iter().flat_map(|&value| (value as f32).to_le_bytes()).collect();
        Self { pixels: pixels.into(), cards, title, unit, picture: OnceLock::new() }
    }

    fn values(&self) -> Vec<f64> {
        let (numbers, _) = self.pixels.as_chunks::<4>();
        numbers.iter().map(|&bytes| f64::from(f32::from_le_bytes(bytes))).collect()
    }

    /// The map as a FITS file, identical to the publisher's; `None` for maps without cards.
    pub(super) fn fits(&self) -> Result<Option<Bytes>, String> {
        let Some(cards) = self.cards.clone() else { return Ok(None) };
        let map = SkyMap::new(Frame::Ecliptic, self.values()).map_err(|error| error.to_string())?;
        let options = WriteOptions { cards, ..WriteOptions::default() };
        let bytes = map_bytes(&map, &options).map_err(|error| error.to_string())?;
        Ok(Some(bytes.into()))
    }

    /// The map as a picture, drawn on the first call.
    pub(super) fn png(&self) -> Result<Bytes, String> {
        if let Some(drawn) = self.picture.get() {
            return Ok(drawn.clone());
        }
        let values = self.values();
        let scaling = if self.unit == "K" { Scaling::Log } else { Scaling::Linear };
        let scale = ColourScale::robust(&values, scaling, Palette::default());
        let panel = MapPanel { values: &values, caption: String::new(), scale, unit: self.unit.to_owned() };
        let view = View { sampling: Sampling::Interpolated, ..View::default() };
        let sheet = Sheet { title: self.title.clone(), width_px: 800, view, ..Sheet::default() };
        let picture = draw_sheet(&[panel], &sheet).map_err(|error| error.to_string())?;
        let bytes = Bytes::from(picture.to_png().map_err(|error| error.to_string())?);
        Ok(self.picture.get_or_init(|| bytes).clone())
    }
}

#[derive(Clone, Debug)]
struct Snapshot {
    number: u32,
    map: Arc<ShownMap>,
}

/// Maps and figures of one channel.
#[derive(Debug)]
struct ChannelMaps {
    frequency_hz: f64,
    nside: usize,
    is_noiseless: bool,
    epoch_tai_s: f64,
    is_final: bool,
    span_s: [f64; 2],
    diagnostics: Diagnostics,
    maps: Vec<Snapshot>,
    noise: Arc<ShownMap>,
    /// Standard deviation (K), mask and resolution (degrees) of the last map; empty if R is not from the data.
    errors: Vec<Arc<ShownMap>>,
    noise_rms_k: f64,
    input: Option<Arc<ShownMap>>,
    figures: Vec<SnapshotSummary>,
    spectra: Option<SpectraOfMap>,
    made: SystemTime,
}

/// Status of a channel's maps.
#[derive(Clone, Debug, Serialize)]
pub(super) struct ChannelStatus {
    channel: u16,
    pub(super) frequency_hz: f64,
    nside: usize,
    is_noiseless: bool,
    epoch_tai_s: f64,
    /// Whether the last map is from all data.
    is_final: bool,
    /// First and last mission time of the data, s.
    span_s: [f64; 2],
    /// Numbers of the maps that are held, ascending; the last is `latest`.
    held: Vec<u32>,
    has_input: bool,
    /// Whether `sigma`, `mask` and `resolution` of the last map are held.
    has_errors: bool,
    pub(super) age_s: f64,
    pub(super) figures: Option<SnapshotSummary>,
    pub(super) noise_rms_k: f64,
    /// Regularisation and convergence of the last map.
    diagnostics: Diagnostics,
}

/// Figures of a channel's maps, and spectra of the last map.
#[derive(Debug, Serialize)]
pub(super) struct ChannelFigures {
    number: Option<u32>,
    snapshots: Vec<SnapshotSummary>,
    spectra: Option<SpectraOfMap>,
}

/// Choice of one map of a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum MapChoice {
    Number(u32),
    Latest,
    Noise,
    Input,
    /// Standard deviation, mask or resolution of the last map, by index.
    Error(usize),
}

/// Names and units of the maps that tell how well the last map is known.
const ERRORS: [(&str, &str); 3] = [("sigma", "K"), ("mask", ""), ("resolution", "deg")];

impl MapChoice {
    pub(super) fn parse(text: &str) -> Option<Self> {
        match text {
            "latest" => Some(Self::Latest),
            "noise" => Some(Self::Noise),
            "input" => Some(Self::Input),
            // No sign and no leading zero, so that each map has one name.
            digits if digits.bytes().all(|digit| digit.is_ascii_digit()) && !digits.starts_with('0') => {
                digits.parse().ok().map(Self::Number)
            }
            other => ERRORS.iter().position(|(name, _)| *name == other).map(Self::Error),
        }
    }
}

/// Cache of the maps of all channels.
#[derive(Debug, Default)]
pub(super) struct MapCache(Mutex<BTreeMap<ChannelId, ChannelMaps>>);

impl MapCache {
    fn channels(&self) -> MutexGuard<'_, BTreeMap<ChannelId, ChannelMaps>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps a copy of a published map; returns a description for the log.
    pub(super) fn put(&self, published: PublishedMap<'_>) -> String {
        let PublishedMap { solution, figures, cards, comparison, input } = published;
        let index = usize::from(solution.channel.0);
        let frequency_hz = solution.instrument.channels.get(index).map_or(0.0, |c| c.frequency_hz);
        let days = (solution.span_s[1] - solution.span_s[0]) / crate::units::constants::DAY_S;
        let title = |what: &str| format!("{what} at {} MHz, {days:.1} days", frequency_hz / 1e6);
        let without_cards =
            |values: &[f64], what, unit| Arc::new(ShownMap::new(values, None, title(what), unit));
        let map = Arc::new(ShownMap::new(&solution.map_k, Some(cards.to_vec()), title("Map"), "K"));
        let noise = without_cards(&solution.noise_k, "Noise", "K");
        let errors = solution.uncertainty.as_ref().map_or_else(Vec::new, |errors| {
            let maps = [&errors.sigma_k, &errors.mask(), &errors.resolution_deg];
            maps.into_iter()
                .zip(ERRORS)
                .map(|(values, (what, unit))| without_cards(values, what, unit))
                .collect()
        });
        let description = format!(
            "map {} at {:.3} MHz: {:.1} days, {} visibilities",
            solution.number,
            frequency_hz / 1e6,
            days,
            group_digits(solution.visibilities as f64)
        );
        let mut channels = self.channels();
        let (mut maps, mut all_figures, old_input) = match channels.remove(&solution.channel) {
            Some(before) => (before.maps, before.figures, before.input),
            None => (Vec::new(), Vec::new(), None),
        };
        maps.push(Snapshot { number: solution.number, map });
        thin(&mut maps, MAPS_MAX);
        all_figures.push(figures.clone());
        thin(&mut all_figures, FIGURES_MAX);
        // The input sky does not change.
        let input = old_input.or_else(|| input.map(|input| without_cards(input.values(), "Input", "K")));
        let channel = ChannelMaps {
            frequency_hz,
            nside: solution.nside,
            is_noiseless: solution.instrument.noiseless,
            epoch_tai_s: solution.instrument.epoch_tai_s,
            is_final: solution.is_final_map(),
            span_s: solution.span_s,
            diagnostics: solution.diagnostics,
            maps,
            noise,
            errors,
            noise_rms_k: rms(&solution.noise_k),
            input,
            figures: all_figures,
            spectra: comparison.map(SpectraOfMap::from),
            made: SystemTime::now(),
        };
        channels.insert(solution.channel, channel);
        thin_all(&mut channels);
        description
    }

    /// A map; `None` if it is not held.
    pub(super) fn map(&self, channel: ChannelId, choice: MapChoice) -> Option<Arc<ShownMap>> {
        let channels = self.channels();
        let held_maps = channels.get(&channel)?;
        match choice {
            MapChoice::Latest => held_maps.maps.last().map(|snapshot| Arc::clone(&snapshot.map)),
            MapChoice::Number(number) => {
                let found = held_maps.maps.iter().find(|snapshot| snapshot.number == number);
                found.map(|snapshot| Arc::clone(&snapshot.map))
            }
            MapChoice::Noise => Some(Arc::clone(&held_maps.noise)),
            MapChoice::Input => held_maps.input.clone(),
            MapChoice::Error(index) => held_maps.errors.get(index).cloned(),
        }
    }

    pub(super) fn status(&self) -> Vec<ChannelStatus> {
        let status = |(channel, held_maps): (&ChannelId, &ChannelMaps)| ChannelStatus {
            channel: channel.0,
            frequency_hz: held_maps.frequency_hz,
            nside: held_maps.nside,
            is_noiseless: held_maps.is_noiseless,
            epoch_tai_s: held_maps.epoch_tai_s,
            is_final: held_maps.is_final,
            span_s: held_maps.span_s,
            held: held_maps.maps.iter().map(|snapshot| snapshot.number).collect(),
            has_input: held_maps.input.is_some(),
            has_errors: !held_maps.errors.is_empty(),
            age_s: held_maps.made.elapsed().map_or(0.0, |age| age.as_secs_f64()),
            figures: held_maps.figures.last().cloned(),
            noise_rms_k: held_maps.noise_rms_k,
            diagnostics: held_maps.diagnostics,
        };
        self.channels().iter().map(status).collect()
    }

    /// Figures of a channel, with spectra of its last map. Without an input sky, the first call computes the spectrum.
    pub(super) fn figures(&self, channel: ChannelId) -> Option<ChannelFigures> {
        let (figures, last, noise, nside) = {
            let channels = self.channels();
            let held_maps = channels.get(&channel)?;
            let last = held_maps.maps.last().cloned();
            let figures = ChannelFigures {
                number: last.as_ref().map(|snapshot| snapshot.number),
                snapshots: held_maps.figures.clone(),
                spectra: held_maps.spectra.clone(),
            };
            let noise = (!held_maps.is_noiseless).then(|| Arc::clone(&held_maps.noise));
            (figures, last, noise, held_maps.nside)
        };
        let Some(last) = last.filter(|_| figures.spectra.is_none() && nside <= SPECTRUM_NSIDE_MAX) else {
            return Some(figures);
        };
        let spectra = spectra_of(&last.map, noise.as_deref(), nside).ok();
        if let Some(held_maps) = self.channels().get_mut(&channel)
            && held_maps.maps.last().map(|snapshot| snapshot.number) == Some(last.number)
        {
            held_maps.spectra.clone_from(&spectra);
        }
        Some(ChannelFigures { spectra, ..figures })
    }
}

fn spectra_of(map: &ShownMap, noise: Option<&ShownMap>, nside: usize) -> Result<SpectraOfMap, MapError> {
    let spectrum = |map: &ShownMap| {
        let map = SkyMap::new(Frame::Ecliptic, map.values())?;
        Ok::<_, MapError>(auto_cl(&map.harmonics(3 * nside - 1, &AnalysisOptions::default())?))
    };
    let cl_noise = noise.map(spectrum).transpose()?;
    Ok(SpectraOfMap { cl_map: spectrum(map)?, cl_noise, ..SpectraOfMap::default() })
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len().max(1) as f64).sqrt()
}

/// Removes every second entry of a list longer than `length_max`, except the first and the last.
fn thin<T>(list: &mut Vec<T>, length_max: usize) {
    if list.len() > length_max {
        let (mut index, last) = (0, list.len() - 1);
        list.retain(|_| {
            index += 1;
            (index - 1) % 2 == 0 || index - 1 == last
        });
    }
}

/// Thins the channel with most bytes until all earlier maps are within [`EARLIER_BYTES_MAX`].
fn thin_all(channels: &mut BTreeMap<ChannelId, ChannelMaps>) {
    let earlier_bytes = |held_maps: &ChannelMaps| {
        let earlier = &held_maps.maps[..held_maps.maps.len().saturating_sub(1)];
        earlier.iter().map(|snapshot| snapshot.map.pixels.len()).sum::<usize>()
    };
    while channels.values().map(earlier_bytes).sum::<usize>() > EARLIER_BYTES_MAX {
        let Some(largest) = channels.values_mut().max_by_key(|held_maps| earlier_bytes(held_maps)) else {
            return;
        };
        match largest.maps.len() {
            0..=2 => {
                let last = largest.maps.pop();
                largest.maps = last.into_iter().collect();
            }
            length => thin(&mut largest.maps, length - 1),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thinned_list_keeps_the_first_and_the_last() {
        let mut list = Vec::new();
        for number in 0..1000 {
            list.push(number);
            thin(&mut list, MAPS_MAX);
            assert!(list.len() <= MAPS_MAX && list[0] == 0 && list[list.len() - 1] == number);
            assert!(list.is_sorted());
        }
    }

    #[test]
    fn maps_have_one_name_each() {
        assert_eq!(MapChoice::parse("latest"), Some(MapChoice::Latest));
        assert_eq!(MapChoice::parse("7"), Some(MapChoice::Number(7)));
        for text in ["", "0", "07", "+7", "-1", "7 ", "4294967296", "LATEST", "../7", "\u{664}"] {
            assert_eq!(MapChoice::parse(text), None, "{text}");
        }
    }
}
