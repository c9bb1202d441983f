//! The maps that the server holds: the last of each channel, and a thinned choice of those before.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::SystemTime;

use axum::body::Bytes;
use serde::Serialize;

use crate::imaging::Diagnostics;
use crate::products::pictures::{ColourScale, MapPanel, Palette, Sampling, Scaling, Sheet, View, draw_sheet};
use crate::products::{PublishedMap, SnapshotSummary};
use crate::sky::fits::{Card, WriteOptions, map_bytes};
use crate::sky::harmonics::AnalysisOptions;
use crate::sky::spectra::auto_cl;
use crate::sky::{Comparison, Frame, MapError, SkyMap};
use crate::units::ChannelId;

/// Most maps held of a channel.
const MAPS_MAX: usize = 32;

/// Most bytes of maps before the last of each channel, all channels together.
const EARLIER_BYTES_MAX: usize = 64 << 20;

/// Most snapshots of a channel whose figures are held.
const FIGURES_MAX: usize = 512;

/// Greatest nside of a map whose spectrum is taken for the page, where no truth has made the publisher take it.
const SPECTRUM_NSIDE_MAX: usize = 64;

/// Spectra of a map, K^2 by degree.
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

/// Pixels in RING order on ecliptic axes, K: little-endian 32-bit numbers, as its file rounds them.
#[derive(Debug)]
pub(super) struct ShownMap {
    pub(super) pixels: Bytes,
    /// Header cards of its file; `None` for a companion, which has no file until the end.
    cards: Option<Vec<Card>>,
    title: String,
    /// Drawn once, when somebody asks.
    picture: OnceLock<Bytes>,
}

impl ShownMap {
    fn new(values: &[f64], cards: Option<Vec<Card>>, title: String) -> Self {
        let pixels: Vec<u8> = values.iter().flat_map(|&value| (value as f32).to_le_bytes()).collect();
        Self { pixels: pixels.into(), cards, title, picture: OnceLock::new() }
    }

    fn values(&self) -> Vec<f64> {
        let (numbers, _) = self.pixels.as_chunks::<4>();
        numbers.iter().map(|&bytes| f64::from(f32::from_le_bytes(bytes))).collect()
    }

    /// The map as a FITS file: the bytes of the publisher's file of the same map; `None` for a companion.
    pub(super) fn fits(&self) -> Result<Option<Bytes>, String> {
        let Some(cards) = self.cards.clone() else { return Ok(None) };
        let map = SkyMap::new(Frame::Ecliptic, self.values()).map_err(|error| error.to_string())?;
        let options = WriteOptions { cards, ..WriteOptions::default() };
        let bytes = map_bytes(&map, &options).map_err(|error| error.to_string())?;
        Ok(Some(bytes.into()))
    }

    /// The map as a picture. Takes a while, the first time.
    pub(super) fn png(&self) -> Result<Bytes, String> {
        if let Some(drawn) = self.picture.get() {
            return Ok(drawn.clone());
        }
        let values = self.values();
        let scale = ColourScale::robust(&values, Scaling::Log, Palette::default());
        let panel = MapPanel { values: &values, caption: String::new(), scale, unit: "K".to_owned() };
        let view = View { sampling: Sampling::Interpolated, ..View::default() };
        let sheet = Sheet { title: self.title.clone(), width_px: 800, view, ..Sheet::default() };
        let picture = draw_sheet(&[panel], &sheet).map_err(|error| error.to_string())?;
        let bytes = Bytes::from(picture.to_png().map_err(|error| error.to_string())?);
        Ok(self.picture.get_or_init(|| bytes).clone())
    }
}

/// One snapshot's map.
#[derive(Clone, Debug)]
struct Snapshot {
    number: u32,
    map: Arc<ShownMap>,
}

#[derive(Debug)]
struct ChannelShelf {
    frequency_hz: f64,
    nside: usize,
    is_noiseless: bool,
    is_final: bool,
    span_s: [f64; 2],
    diagnostics: Diagnostics,
    maps: Vec<Snapshot>,
    noise: Arc<ShownMap>,
    noise_rms_k: f64,
    input: Option<Arc<ShownMap>>,
    figures: Vec<SnapshotSummary>,
    spectra: Option<SpectraOfMap>,
    /// When the last map was made.
    made: SystemTime,
}

/// A channel in the status.
#[derive(Clone, Debug, Serialize)]
pub(super) struct ChannelStatus {
    /// Number of the channel.
    channel: u16,
    /// Frequency, Hz.
    pub(super) frequency_hz: f64,
    /// nside of its maps.
    nside: usize,
    /// Whether its data hold no thermal noise.
    is_noiseless: bool,
    /// Whether the last map is from all data.
    is_final: bool,
    /// First and last mission time of the data, s.
    span_s: [f64; 2],
    /// Numbers of the maps that are held, rising; the last is `latest`.
    held: Vec<u32>,
    /// Whether the true sky is known.
    has_input: bool,
    /// Time since the last map was made, s.
    pub(super) age_s: f64,
    /// Figures of the last map.
    pub(super) figures: Option<SnapshotSummary>,
    /// RMS of the noise-only map, K.
    pub(super) noise_rms_k: f64,
    /// Regularisation and convergence of the last map.
    diagnostics: Diagnostics,
}

/// Figures of a channel's maps, and spectra of the last.
#[derive(Debug, Serialize)]
pub(super) struct ChannelFigures {
    number: Option<u32>,
    snapshots: Vec<SnapshotSummary>,
    spectra: Option<SpectraOfMap>,
}

/// Which map of a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum MapChoice {
    Number(u32),
    Latest,
    Noise,
    Input,
}

impl MapChoice {
    pub(super) fn read(text: &str) -> Option<Self> {
        match text {
            "latest" => Some(Self::Latest),
            "noise" => Some(Self::Noise),
            "input" => Some(Self::Input),
            // Digits alone: no sign, no leading zero, so that a map has one name.
            digits if digits.bytes().all(|digit| digit.is_ascii_digit()) && !digits.starts_with('0') => {
                digits.parse().ok().map(Self::Number)
            }
            _ => None,
        }
    }
}

/// The maps of all channels.
#[derive(Debug, Default)]
pub(super) struct Shelf(Mutex<BTreeMap<ChannelId, ChannelShelf>>);

impl Shelf {
    fn channels(&self) -> MutexGuard<'_, BTreeMap<ChannelId, ChannelShelf>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps a copy of a published map; returns its description.
    pub(super) fn put(&self, published: PublishedMap<'_>) -> String {
        let PublishedMap { solution, figures, cards, comparison, input } = published;
        let index = usize::from(solution.channel.0);
        let frequency_hz = solution.instrument.channels.get(index).map_or(0.0, |c| c.frequency_hz);
        let days = (solution.span_s[1] - solution.span_s[0]) / crate::units::constants::DAY_S;
        let title = |what: &str| format!("{what} at {} MHz, {days:.1} days", frequency_hz / 1e6);
        let companion = |values: &[f64], what| Arc::new(ShownMap::new(values, None, title(what)));
        let map = Arc::new(ShownMap::new(&solution.map_k, Some(cards.to_vec()), title("Map")));
        let noise = companion(&solution.noise_k, "Noise");
        let said = format!(
            "map {} at {:.3} MHz: {:.1} days, {} visibilities",
            solution.number,
            frequency_hz / 1e6,
            days,
            solution.visibilities
        );
        let mut channels = self.channels();
        let before = channels.remove(&solution.channel);
        let (mut maps, mut all_figures, old_input) =
            before.map_or((Vec::new(), Vec::new(), None), |shelf| (shelf.maps, shelf.figures, shelf.input));
        maps.push(Snapshot { number: solution.number, map });
        thin(&mut maps, MAPS_MAX);
        all_figures.push(figures.clone());
        thin(&mut all_figures, FIGURES_MAX);
        // The sky does not change.
        let input = old_input.or_else(|| input.map(|input| companion(input.values(), "Input")));
        let shelf = ChannelShelf {
            frequency_hz,
            nside: solution.nside,
            is_noiseless: solution.instrument.noiseless,
            is_final: solution.is_final_map(),
            span_s: solution.span_s,
            diagnostics: solution.diagnostics,
            maps,
            noise,
            noise_rms_k: rms(&solution.noise_k),
            input,
            figures: all_figures,
            spectra: comparison.map(SpectraOfMap::from),
            made: SystemTime::now(),
        };
        channels.insert(solution.channel, shelf);
        thin_all(&mut channels);
        said
    }

    /// A map; `None` if it is not held.
    pub(super) fn map(&self, channel: ChannelId, which: MapChoice) -> Option<Arc<ShownMap>> {
        let channels = self.channels();
        let shelf = channels.get(&channel)?;
        match which {
            MapChoice::Latest => shelf.maps.last().map(|snapshot| Arc::clone(&snapshot.map)),
            MapChoice::Number(number) => {
                let found = shelf.maps.iter().find(|snapshot| snapshot.number == number);
                found.map(|snapshot| Arc::clone(&snapshot.map))
            }
            MapChoice::Noise => Some(Arc::clone(&shelf.noise)),
            MapChoice::Input => shelf.input.clone(),
        }
    }

    /// The channels in the status.
    pub(super) fn status(&self) -> Vec<ChannelStatus> {
        let status = |(channel, shelf): (&ChannelId, &ChannelShelf)| ChannelStatus {
            channel: channel.0,
            frequency_hz: shelf.frequency_hz,
            nside: shelf.nside,
            is_noiseless: shelf.is_noiseless,
            is_final: shelf.is_final,
            span_s: shelf.span_s,
            held: shelf.maps.iter().map(|snapshot| snapshot.number).collect(),
            has_input: shelf.input.is_some(),
            age_s: shelf.made.elapsed().map_or(0.0, |age| age.as_secs_f64()),
            figures: shelf.figures.last().cloned(),
            noise_rms_k: shelf.noise_rms_k,
            diagnostics: shelf.diagnostics,
        };
        self.channels().iter().map(status).collect()
    }

    /// Figures of a channel, with spectra of its last map. Takes a while if there is no truth.
    pub(super) fn figures(&self, channel: ChannelId) -> Option<ChannelFigures> {
        let (figures, last, nside) = {
            let channels = self.channels();
            let shelf = channels.get(&channel)?;
            let last = shelf.maps.last().cloned();
            let figures = ChannelFigures {
                number: last.as_ref().map(|snapshot| snapshot.number),
                snapshots: shelf.figures.clone(),
                spectra: shelf.spectra.clone(),
            };
            (figures, last, shelf.nside)
        };
        let Some(last) = last.filter(|_| figures.spectra.is_none() && nside <= SPECTRUM_NSIDE_MAX) else {
            return Some(figures);
        };
        let spectra = spectrum_of(&last.map, nside).ok();
        if let Some(shelf) = self.channels().get_mut(&channel)
            && shelf.maps.last().map(|snapshot| snapshot.number) == Some(last.number)
        {
            shelf.spectra.clone_from(&spectra);
        }
        Some(ChannelFigures { spectra, ..figures })
    }
}

fn spectrum_of(map: &ShownMap, nside: usize) -> Result<SpectraOfMap, MapError> {
    let map = SkyMap::new(Frame::Ecliptic, map.values())?;
    let alm = map.harmonics(3 * nside - 1, &AnalysisOptions::default())?;
    Ok(SpectraOfMap { cl_map: auto_cl(&alm), ..SpectraOfMap::default() })
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len().max(1) as f64).sqrt()
}

/// Removes every second entry of a list that is too long, but never the first and the last.
fn thin<T>(list: &mut Vec<T>, most: usize) {
    if list.len() > most {
        let (mut place, last) = (0, list.len() - 1);
        list.retain(|_| {
            place += 1;
            (place - 1) % 2 == 0 || place - 1 == last
        });
    }
}

/// Thins the longest lists until all earlier maps together are few enough.
fn thin_all(channels: &mut BTreeMap<ChannelId, ChannelShelf>) {
    let earlier = |shelf: &ChannelShelf| {
        let before_last = &shelf.maps[..shelf.maps.len().saturating_sub(1)];
        before_last.iter().map(|snapshot| snapshot.map.pixels.len()).sum::<usize>()
    };
    while channels.values().map(earlier).sum::<usize>() > EARLIER_BYTES_MAX {
        let Some(most) = channels.values_mut().max_by_key(|shelf| earlier(shelf)) else { return };
        match most.maps.len() {
            0..=2 => {
                let last = most.maps.pop();
                most.maps = last.into_iter().collect();
            }
            length => thin(&mut most.maps, length - 1),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thinned_list_goes_from_the_first_to_the_last() {
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
        assert_eq!(MapChoice::read("latest"), Some(MapChoice::Latest));
        assert_eq!(MapChoice::read("7"), Some(MapChoice::Number(7)));
        for text in ["", "0", "07", "+7", "-1", "7 ", "4294967296", "LATEST", "../7", "\u{664}"] {
            assert_eq!(MapChoice::read(text), None, "{text}");
        }
    }
}
