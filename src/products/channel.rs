//! The products of one channel.

use std::path::{Path, PathBuf};

use super::beam::EffectiveBeam;
use super::config::{PostProcessing, ProductsConfig};
use super::error::ProductsError;
use super::error_maps::ErrorMap;
use super::latitudes::latitude_errors;
use super::pictures::{
    Axis, Bars, ColourScale, Curve, MapPanel, Palette, Picture, PictureError, Plot, Sampling, Scaling, Sheet,
    View, draw_map, draw_plots, draw_sheet,
};
use super::point_beams::{PointBeamSummary, beams_csv};
use super::provenance::Provenance;
use super::summary::{ChannelSummary, PowerSpectra, SnapshotSummary};
use super::truth::ChannelTruth;
use super::viewer::{MapWatch, PublishedMap};
use crate::files::{disk_room, write_atomically};
use crate::imaging::Solution;
use crate::sky::fits::{WriteOptions, write_map};
use crate::sky::spectra::gaussian_beam;
use crate::sky::{Comparison, Frame, InputSky, SkyMap, compare_with, is_unseen};
use crate::units::constants::DAY_S;

/// Part of its disk that a listening ground leaves free.
const KEPT_FREE: u64 = 20;

/// Maximum number of maps on the sheet of snapshots: the first, the last and some between.
const SHEET_MAPS_MAX: usize = 6;

/// Fixed names of the last map and its picture. They are files of their own, as links break where a folder is copied or packed.
const LATEST_MAP: &str = "latest.fits";
const LATEST_PICTURE: &str = "latest.png";

/// A channel's output folder, and the summary of its maps so far.
pub(super) struct ChannelFolder {
    config: ProductsConfig,
    /// Output folder of the run.
    root: PathBuf,
    /// Name of the channel's folder within `root`.
    name: String,
    frequency_hz: f64,
    truth: Option<ChannelTruth>,
    /// Snapshots for the sheet.
    shown: SheetMaps,
    snapshots: Vec<SnapshotSummary>,
    files: Vec<String>,
    summary: Option<ChannelSummary>,
    beams: Vec<PointBeamSummary>,
    /// Whether it leaves a part of the disk free.
    leaves_room: bool,
}

impl ChannelFolder {
    /// Creates the folder, for example `root/3.000MHz`.
    pub(super) fn open(
        root: &Path,
        config: &ProductsConfig,
        truth: Option<&ChannelTruth>,
        solution: &Solution,
    ) -> Result<Self, ProductsError> {
        let channel = usize::from(solution.channel.0);
        let frequency_hz = solution.instrument.channels.get(channel).map_or(0.0, |c| c.frequency_hz);
        let name = format!("{:.3}MHz", frequency_hz / 1e6);
        let folder = root.join(&name);
        std::fs::create_dir_all(&folder)
            .map_err(|source| ProductsError::Write { path: folder.clone(), source })?;
        Ok(Self {
            config: config.clone(),
            root: root.to_owned(),
            name,
            frequency_hz,
            truth: truth.cloned(),
            shown: SheetMaps::default(),
            snapshots: Vec::new(),
            files: Vec::new(),
            summary: None,
            beams: Vec::new(),
            leaves_room: false,
        })
    }

    /// Leaves a part of the disk free for the state and the raw archive of a ground, which may be on the same one.
    pub(super) fn leaving_room(self) -> Self {
        Self { leaves_room: true, ..self }
    }

    /// Lets final maps take the rest of the disk: nothing comes after them.
    fn require_room(&self, solution: &Solution) -> Result<(), ProductsError> {
        let leaves = self.leaves_room && !solution.is_final;
        match disk_room(&self.root).filter(|_| leaves) {
            Some([free, size]) if free < size / KEPT_FREE => {
                let reason = "less than a twentieth of the disk is free, which is left to state and archive";
                let source = std::io::Error::new(std::io::ErrorKind::StorageFull, reason);
                Err(ProductsError::Write { path: self.root.clone(), source })
            }
            _ => Ok(()),
        }
    }

    /// Writes the products of one solution; the complete set if it is final. If they cannot be written, only viewers see the map.
    pub(super) fn publish(
        &mut self,
        solution: &Solution,
        provenance: &Provenance,
        viewers: &MapWatch,
    ) -> Result<(), ProductsError> {
        let (snapshots, beams) = (self.snapshots.len(), self.beams.len());
        let published = self.publish_whole(solution, provenance, viewers);
        if published.is_err() {
            if self.snapshots.len() > snapshots {
                self.show(None, Origin { provenance, solution }, viewers);
            }
            self.snapshots.truncate(snapshots);
            self.beams.truncate(beams);
        }
        published
    }

    fn publish_whole(
        &mut self,
        solution: &Solution,
        provenance: &Provenance,
        viewers: &MapWatch,
    ) -> Result<(), ProductsError> {
        let solved = ShownMaps {
            map: SkyMap::new(Frame::Ecliptic, solution.map_k.clone())?,
            noise: SkyMap::new(Frame::Ecliptic, solution.noise_k.clone())?,
            processing: None,
        };
        let origin = Origin { provenance, solution };
        let processed =
            self.config.processing().map(|processing| solved.processed(processing)).transpose()?;
        let shown = processed.as_ref().unwrap_or(&solved);
        let comparison = self.compare(solution, shown)?;
        self.note(solution, shown, comparison.as_ref());
        self.require_room(solution)?;
        if self.config.snapshot_maps && !solution.is_final {
            let name = format!("{}.fits", map_name(solution));
            self.write_map(&name, &solved.map, None, origin)?;
        }
        if self.config.pictures {
            self.shown.offer(shown.map.values(), &caption(solution));
            self.draw_snapshot(solution, shown)?;
        }
        self.write_named(LATEST_MAP, &map_name(solution), &solved.map, None, origin)?;
        if solution.is_final {
            for maps in [Some(&solved), processed.as_ref()].into_iter().flatten() {
                self.write_final(maps, origin)?;
            }
            self.write_beams(origin)?;
            if self.config.pictures {
                self.draw_final(shown, comparison.as_ref(), origin)?;
            }
        }
        self.show(comparison.as_ref(), origin, viewers);
        if solution.is_final {
            self.summary = Some(self.summarise(solution, shown, comparison));
        }
        Ok(())
    }

    /// Shows the map to viewers, as its file has it.
    fn show(&self, comparison: Option<&Comparison>, origin: Origin<'_>, viewers: &MapWatch) {
        let Origin { provenance, solution } = origin;
        let Some(figures) = self.snapshots.last() else { return };
        viewers.offer(|viewer| {
            let cards = provenance.cards(solution, &map_name(solution), None);
            let input = self.input(None).map(|input| &input.map);
            viewer.view(PublishedMap { solution, figures, cards: &cards, comparison, input });
        });
    }

    /// The truth beside maps that are shown.
    fn input(&self, processing: Option<PostProcessing>) -> Option<&InputSky> {
        let truth = self.truth.as_ref()?;
        if processing.is_some() { truth.processed.as_ref() } else { Some(&truth.plain) }
    }

    fn compare(&self, solution: &Solution, shown: &ShownMaps) -> Result<Option<Comparison>, ProductsError> {
        let Some(input) = self.input(shown.processing) else { return Ok(None) };
        // A harmonic map has no power beyond its own degrees; split pixels have no more than before.
        let l_max = solution.diagnostics.l_max.unwrap_or(3 * solution.nside - 1);
        let comparison = compare_with(&shown.map, input, Some(&shown.noise), Some(l_max))?;
        let is_noisy = !solution.instrument.noiseless;
        Ok(Some(if is_noisy { comparison.with_noise_subtracted() } else { comparison }))
    }

    /// The summary, if there was a final map.
    pub(super) fn into_summary(self) -> Option<ChannelSummary> {
        self.summary.map(|summary| ChannelSummary { files: self.files, ..summary })
    }

    fn note(&mut self, solution: &Solution, shown: &ShownMaps, comparison: Option<&Comparison>) {
        let input = self.input(shown.processing);
        let rms_error_over_rms_truth =
            input.map(|input| rms_error_over_rms_truth(shown.map.values(), input.map.values()));
        self.snapshots.push(SnapshotSummary {
            number: solution.number,
            until_s: solution.span_s[1],
            visibilities: solution.visibilities,
            rms_error_over_rms_truth,
            rho_mean: comparison.map(|c| mean_rho(&c.rho, 2 * solution.nside)),
        });
    }

    fn summarise(
        &self,
        solution: &Solution,
        shown: &ShownMaps,
        comparison: Option<Comparison>,
    ) -> ChannelSummary {
        let (pixels, errors) = (solution.map_k.len() as f64, solution.uncertainty.as_ref());
        let beam = comparison.as_ref().map(|comparison| {
            let l_max = comparison.cl_map.len().saturating_sub(1);
            let smoothing = shown.processing.map_or(0.0, PostProcessing::fwhm_rad);
            let smoothing = gaussian_beam(smoothing, l_max);
            EffectiveBeam::new(comparison, &smoothing, shown.noise.values(), self.frequency_hz)
        });
        let latitudes = comparison.as_ref().map(latitude_errors);
        let power = comparison.as_ref().map(|c| PowerSpectra {
            map_k2: c.cl_map.clone(),
            input_k2: c.cl_truth.clone(),
            cross_k2: c.cl_cross.clone(),
            noise_k2: c.cl_noise.clone(),
        });
        let (rho, rho_noise_subtracted, snr) =
            comparison.map_or((None, None, None), |c| (Some(c.rho), c.rho_noise_subtracted, c.snr));
        ChannelSummary {
            frequency_hz: self.frequency_hz,
            seed: solution.instrument.seed,
            space_hash: format!("{:016x}", solution.instrument.configuration_hash),
            nside: solution.nside,
            span_s: solution.span_s,
            visibilities: solution.visibilities,
            mean_k: solution.map_k.iter().sum::<f64>() / pixels,
            mean_sigma_k: errors.map(|errors| errors.mean_sigma_k),
            dipole_k: errors.map(|errors| errors.dipole_k),
            dipole_sigma_k: errors.map(|errors| errors.dipole_sigma_k),
            sky_power: errors.map(|errors| errors.power.clone()),
            noise_rms_k: (solution.noise_k.iter().map(|x| x * x).sum::<f64>() / pixels).sqrt(),
            diagnostics: solution.diagnostics,
            refinement: solution.refinement.clone(),
            snapshots: self.snapshots.clone(),
            thermal_noise: !solution.instrument.noiseless,
            post_processing: self.config.processing(),
            rho,
            rho_noise_subtracted,
            snr,
            power,
            beam,
            point_beams: self.beams.clone(),
            latitudes,
            files: Vec::new(),
        }
    }

    /// A path in the channel's folder, recorded in the list of files.
    fn file(&mut self, name: &str) -> PathBuf {
        let relative = format!("{}/{name}", self.name);
        let path = self.root.join(&relative);
        if !self.files.contains(&relative) {
            self.files.push(relative);
        }
        path
    }

    fn write_map(
        &mut self,
        name: &str,
        map: &SkyMap,
        processing: Option<PostProcessing>,
        origin: Origin<'_>,
    ) -> Result<(), ProductsError> {
        self.write_named(name, name.trim_end_matches(".fits"), map, processing, origin)
    }

    /// Writes a map; `what` describes it in the header.
    fn write_named(
        &mut self,
        name: &str,
        what: &str,
        map: &SkyMap,
        processing: Option<PostProcessing>,
        Origin { provenance, solution }: Origin<'_>,
    ) -> Result<(), ProductsError> {
        let cards = provenance.cards(solution, what, processing);
        let options = WriteOptions { cards, ..WriteOptions::default() };
        let path = self.file(name);
        Ok(write_map(&path, map, &options)?)
    }

    /// Map, noise and input, as solved or post-processed.
    fn write_final(&mut self, maps: &ShownMaps, origin: Origin<'_>) -> Result<(), ProductsError> {
        let &ShownMaps { ref map, ref noise, processing } = maps;
        let ending = if processing.is_some() { "-smooth" } else { "" };
        self.write_map(&format!("map{ending}.fits"), map, processing, origin)?;
        self.write_map(&format!("noise{ending}.fits"), noise, processing, origin)?;
        if let Some(input) = self.input(processing).map(|input| input.map.clone()) {
            self.write_map(&format!("input{ending}.fits"), &input, processing, origin)?;
        }
        if let Some(errors) = &origin.solution.uncertainty {
            for map in ErrorMap::all(errors) {
                let what = map.file.trim_end_matches(".fits");
                let cards = origin.provenance.cards(origin.solution, what, None);
                self.file(map.file);
                map.write(&self.root.join(&self.name), &WriteOptions { cards, ..WriteOptions::default() })?;
            }
            let path = self.file("sky-power.csv");
            write_atomically(&path, errors.power.csv().as_bytes())
                .map_err(|source| ProductsError::Write { path, source })?;
        }
        if let Some(refinement) = &origin.solution.refinement {
            let path = self.file("residuals.csv");
            write_atomically(&path, refinement.chi_square.csv().as_bytes())
                .map_err(|source| ProductsError::Write { path, source })?;
        }
        Ok(())
    }

    /// Beams as maps, solved and post-processed, and a table of their widths.
    fn write_beams(&mut self, origin: Origin<'_>) -> Result<(), ProductsError> {
        let Origin { solution, .. } = origin;
        for (number, beam) in solution.beams.iter().enumerate() {
            let map = SkyMap::new(Frame::Ecliptic, beam.map_k.clone())?;
            let processing = self.config.processing();
            let processed = processing.map(|processing| processing.apply(&map)).transpose()?;
            self.write_map(&format!("beam-{}.fits", number + 1), &map, None, origin)?;
            if let Some(processed) = &processed {
                self.write_map(&format!("beam-{}-smooth.fits", number + 1), processed, processing, origin)?;
            }
            let l_max = solution.diagnostics.l_max;
            self.beams.push(PointBeamSummary::new(beam.pixel, &map, l_max, processed.as_ref())?);
        }
        if !self.beams.is_empty() {
            let path = self.file("beams.csv");
            write_atomically(&path, beams_csv(&self.beams).as_bytes())
                .map_err(|source| ProductsError::Write { path, source })?;
        }
        Ok(())
    }

    /// The colour scale that map and input share: the range of the input, or of the map if there is no input.
    fn scale(&self, shown: &ShownMaps) -> ColourScale {
        let input = self.input(shown.processing).map(|input| &input.map);
        let reference = input.unwrap_or(&shown.map).values();
        ColourScale::robust(reference, Scaling::Log, Palette::default())
    }

    fn panel<'a>(&self, values: &'a [f64], caption: &str, scale: ColourScale) -> MapPanel<'a> {
        MapPanel { values, caption: caption.to_owned(), scale, unit: "K".to_owned() }
    }

    fn draw_snapshot(&mut self, solution: &Solution, shown: &ShownMaps) -> Result<(), ProductsError> {
        let map = shown.map.values();
        let title = format!("{} MHz, {}", self.frequency_hz / 1e6, caption(solution));
        let subtitle = format!("{} visibilities", solution.visibilities);
        let panel = self.panel(map, "", self.scale(shown));
        let path = self.file(&format!("snapshot-{:03}.png", solution.number));
        // Half the size of the final picture, because there are many.
        let sheet =
            Sheet { title, subtitle, width_px: 800, view: view(self.config.frame), ..Sheet::default() };
        let picture = draw_sheet(&[panel], &sheet)?;
        picture.write(&path)?;
        // The final map has its own picture.
        if !solution.is_final {
            picture.write(&self.file(LATEST_PICTURE))?;
        }
        Ok(())
    }

    fn draw_final(
        &mut self,
        shown: &ShownMaps,
        comparison: Option<&Comparison>,
        Origin { provenance, solution }: Origin<'_>,
    ) -> Result<(), ProductsError> {
        let mhz = self.frequency_hz / 1e6;
        let map = shown.map.values();
        let scale = self.scale(shown);
        let how = provenance.caption(solution);
        let subtitle = format!("{} visibilities, {}; {how}", solution.visibilities, shown.resolution());
        let panel = self.panel(map, &format!("Map at {mhz} MHz"), scale);
        let picture = draw_map(&panel, &subtitle, &view(self.config.frame))?;
        self.write_picture("map", &picture)?;
        picture.write(&self.file(LATEST_PICTURE))?;
        if let Some(input) = self.input(shown.processing).cloned() {
            let panel = self.panel(input.map.values(), &format!("Input at {mhz} MHz"), scale);
            let picture = draw_map(&panel, &shown.resolution(), &view(self.config.frame))?;
            self.write_picture("input", &picture)?;
        }
        if let Some(comparison) = comparison {
            let title = format!("Relative error at {mhz} MHz");
            let picture = draw_relative_error(&title, &subtitle, comparison, self.config.frame)?;
            self.write_picture("error", &picture)?;
            let noise = if solution.instrument.noiseless { "without" } else { "with" };
            let title = format!("{mhz} MHz, {}, {noise} thermal noise", shown.resolution());
            self.write_picture("spectra", &draw_comparison(&title, comparison)?)?;
        }
        self.draw_sheet(shown, &caption(solution), scale)
    }

    /// Draws the sheet of snapshots.
    fn draw_sheet(
        &mut self,
        last: &ShownMaps,
        caption: &str,
        scale: ColourScale,
    ) -> Result<(), ProductsError> {
        let shown = self.shown.spread((last.map.values(), caption));
        let panels: Vec<MapPanel<'_>> = shown.map(|(map, caption)| self.panel(map, caption, scale)).collect();
        let sheet = Sheet {
            title: format!("The map at {} MHz sharpens", self.frequency_hz / 1e6),
            columns: 3,
            width_px: 1800,
            bars: Bars::Shared,
            view: view(self.config.frame),
            ..Sheet::default()
        };
        let picture = draw_sheet(&panels, &sheet)?;
        self.write_picture("sharpening", &picture)
    }

    /// Writes a final picture, and the same as SVG if configured.
    fn write_picture(&mut self, name: &str, picture: &Picture) -> Result<(), ProductsError> {
        let path = self.file(&format!("{name}.png"));
        picture.write(&path)?;
        if self.config.svg {
            let path = self.file(&format!("{name}.svg"));
            picture.write(&path)?;
        }
        Ok(())
    }
}

/// Where a map comes from.
#[derive(Clone, Copy)]
struct Origin<'a> {
    provenance: &'a Provenance,
    solution: &'a Solution,
}

/// A map and its noise-only companion, as solved or post-processed.
struct ShownMaps {
    map: SkyMap,
    noise: SkyMap,
    /// How they were processed.
    processing: Option<PostProcessing>,
}

impl ShownMaps {
    fn processed(&self, processing: PostProcessing) -> Result<Self, ProductsError> {
        let apply = |map: &SkyMap| processing.apply(map);
        Ok(Self { map: apply(&self.map)?, noise: apply(&self.noise)?, processing: Some(processing) })
    }

    /// The processing in words.
    fn resolution(&self) -> String {
        let nside = self.map.nside();
        match self.processing {
            None => format!("nside {nside}"),
            Some(PostProcessing { split, fwhm_deg }) => {
                format!("nside {} split to {nside}, FWHM {fwhm_deg} deg", nside / split)
            }
        }
    }
}

/// A bounded selection of snapshots: the first, and every 2^n-th after it.
#[derive(Default)]
struct SheetMaps {
    /// Maps with their captions.
    maps: Vec<(Vec<f64>, String)>,
    /// Number of maps offered so far.
    offered: usize,
    /// log2 of the number of maps offered per map kept.
    halvings: u32,
}

impl SheetMaps {
    /// Offers a map, which is kept if its number is due.
    fn offer(&mut self, map: &[f64], caption: &str) {
        let is_kept = |offered: usize, halvings: u32| offered.is_multiple_of(1 << halvings);
        if is_kept(self.offered, self.halvings) && self.maps.len() == 2 * SHEET_MAPS_MAX {
            let mut is_odd = true;
            self.maps.retain(|_| {
                is_odd = !is_odd;
                !is_odd
            });
            self.halvings += 1;
        }
        if is_kept(self.offered, self.halvings) {
            self.maps.push((map.to_vec(), caption.to_owned()));
        }
        self.offered += 1;
    }

    /// The maps for the sheet, in equal steps from the first to `last`, which was offered last.
    fn spread<'a>(&'a self, last: (&'a [f64], &'a str)) -> impl Iterator<Item = (&'a [f64], &'a str)> {
        let is_last = |k: usize| (k << self.halvings) + 1 == self.offered;
        let others = (0..self.maps.len()).filter(|&k| !is_last(k)).count();
        let places = SHEET_MAPS_MAX.min(others + 1);
        (0..places).map(move |place| {
            let k = if places > 1 { place * others / (places - 1) } else { 0 };
            let kept = self.maps[..others].get(k);
            kept.map_or(last, |(map, caption)| (map.as_slice(), caption.as_str()))
        })
    }
}

/// Name of a map's file without its extension.
fn map_name(solution: &Solution) -> String {
    if solution.is_final { "map".to_owned() } else { format!("snapshot-{:03}", solution.number) }
}

fn caption(solution: &Solution) -> String {
    format!("after {:.0} days", (solution.span_s[1] - solution.span_s[0]) / DAY_S)
}

/// Maps of the chain are on ecliptic axes.
fn view(frame: Frame) -> View {
    View { sampling: Sampling::Interpolated, ..View::of(frame, Frame::Ecliptic) }
}

/// RMS of (map - truth) divided by RMS of truth.
fn rms_error_over_rms_truth(map: &[f64], truth: &[f64]) -> f64 {
    let difference: f64 = map.iter().zip(truth).map(|(m, t)| (m - t) * (m - t)).sum();
    let scale: f64 = truth.iter().map(|t| t * t).sum();
    (difference / scale).sqrt()
}

/// Mean of rho_l over 1 <= l <= `l_max`.
fn mean_rho(rho: &[f64], l_max: usize) -> f64 {
    let range = &rho[1.min(rho.len())..rho.len().min(l_max + 1)];
    range.iter().sum::<f64>() / range.len().max(1) as f64
}

/// Draws (map - truth) / truth over the sky, percent, in a celestial frame.
///
/// # Errors
/// A page that is too large, which one map is not.
pub fn draw_relative_error(
    title: &str,
    subtitle: &str,
    comparison: &Comparison,
    frame: Frame,
) -> Result<Picture, PictureError> {
    let map = &comparison.relative_error_map;
    let percent = |&value: &f64| if is_unseen(value) { value } else { 100.0 * value };
    let values: Vec<f64> = map.values().iter().map(percent).collect();
    let panel = MapPanel {
        values: &values,
        caption: title.to_owned(),
        scale: ColourScale::symmetric(&values),
        unit: "% of the truth".to_owned(),
    };
    let view = View { sampling: Sampling::Interpolated, ..View::of(frame, map.frame()) };
    draw_map(&panel, subtitle, &view)
}

/// Draws rho_l, the angular power spectra and SNR_l as curves.
///
/// # Errors
/// A page that is too large, which three plots are not.
pub fn draw_comparison(title: &str, comparison: &Comparison) -> Result<Picture, PictureError> {
    let curve = |label: &str, values: &[f64], dashed: bool| Curve {
        label: label.to_owned(),
        points: comparison.l.iter().map(|&l| l as f64).zip(values.iter().copied()).collect(),
        dashed,
    };
    let correlations = match &comparison.rho_noise_subtracted {
        None => vec![curve("", &comparison.rho, false)],
        Some(quiet) => vec![
            curve("with the map's noise", &comparison.rho, false),
            curve("its power subtracted", quiet, true),
        ],
    };
    let l = Axis { label: "degree l".to_owned(), ..Axis::default() };
    let mut plots = vec![
        Plot {
            title: "Correlation with the input".to_owned(),
            x: l.clone(),
            y: Axis { label: "rho_{l}".to_owned(), limits: Some((0.0, 1.05)), log: false },
            curves: correlations,
            levels: vec![1.0],
        },
        Plot {
            title: "Angular power".to_owned(),
            x: l.clone(),
            y: Axis { label: "C_{l} (K²)".to_owned(), log: true, limits: None },
            curves: vec![
                curve("map", &comparison.cl_map, false),
                curve("input", &comparison.cl_truth, true),
                curve("cross", &comparison.cl_cross, false),
            ],
            levels: Vec::new(),
        },
    ];
    if let Some(snr) = &comparison.snr {
        plots.push(Plot {
            title: "Signal to noise".to_owned(),
            x: l,
            y: Axis { label: "SNR_{l}".to_owned(), log: true, limits: None },
            curves: vec![curve("", snr, false)],
            levels: vec![1.0],
        });
    }
    draw_plots(title, &plots, plots.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sheet_goes_from_the_first_map_to_the_last_in_bounded_memory() {
        for count in [1, 2, 5, 6, 7, 12, 13, 24, 25, 100, 471] {
            let mut shown = SheetMaps::default();
            for k in 0..count {
                shown.offer(&[k as f64], &k.to_string());
                assert!(shown.maps.len() <= 2 * SHEET_MAPS_MAX);
            }
            let last = count - 1;
            let sheet: Vec<(f64, String)> = shown
                .spread((&[last as f64], &last.to_string()))
                .map(|(map, caption)| (map[0], caption.to_owned()))
                .collect();
            assert_eq!(sheet.len(), SHEET_MAPS_MAX.min(count));
            assert_eq!((sheet[0].0, sheet[sheet.len() - 1].0), (0.0, last as f64));
            for (map, caption) in &sheet {
                assert_eq!(&map.to_string(), caption);
            }
            // Steps are whole multiples of the kept maps, a twelfth to a sixth of all: half to twice the equal step.
            let equal = last as f64 / (sheet.len().max(2) - 1) as f64;
            let steps = sheet.windows(2).map(|two| two[1].0 - two[0].0);
            assert!(
                steps.clone().all(|step| step >= 0.4 * equal && step <= 2.0 * equal),
                "{count}: {sheet:?}"
            );
        }
    }
}
