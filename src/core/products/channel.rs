//! Writes the products of one channel.

use std::path::{Path, PathBuf};

use super::beam::EffectiveBeam;
use super::comparison_pictures::{draw_comparison, draw_relative_error};
use super::config::{PostProcessing, ProductsConfig};
use super::error::{ProductsError, create_folder, write_product};
use super::error_maps::{ErrorMap, errors_low_by, limits};
use super::latitudes::latitude_errors;
use super::pictures::{
    Bars, ColourScale, MapPanel, Palette, Picture, Sampling, Scaling, Sheet, View, draw_map, draw_sheet,
};
use super::point_beams::{PointBeamSummary, beams_csv};
use super::provenance::Provenance;
use super::sheet_maps::SheetMaps;
use super::summary::{ChannelSummary, PowerSpectra, SnapshotSummary};
use super::truth::ChannelTruth;
use super::viewer::{MapWatch, PublishedMap};
use crate::files::disk_space;
use crate::imaging::Solution;
use crate::sky::fits::{Card, WriteOptions, write_map};
use crate::sky::spectra::gaussian_beam;
use crate::sky::{Comparison, Frame, InputSky, SkyMap, compare_with};
use crate::units::constants::DAY_S;
use crate::units::frequency_folder;

/// Reciprocal of the fraction of the disk that products leave free, while a ground stage listens.
const FREE_DIVISOR: u64 = 20;

/// Fixed names of copies of the last map and its picture. They are not links, which break if a folder is copied or packed.
const LATEST_MAP: &str = "latest.fits";
const LATEST_PICTURE: &str = "latest.png";

/// The output folder of a channel, and what the summary says of its maps so far.
pub(super) struct ChannelFolder {
    config: ProductsConfig,
    root: PathBuf,
    name: String,
    frequency_hz: f64,
    truth: Option<ChannelTruth>,
    sheet_maps: SheetMaps,
    snapshots: Vec<SnapshotSummary>,
    files: Vec<String>,
    summary: Option<ChannelSummary>,
    point_beams: Vec<PointBeamSummary>,
    needs_free_disk: bool,
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
        let name = frequency_folder(frequency_hz);
        create_folder(&root.join(&name))?;
        Ok(Self {
            config: config.clone(),
            root: root.to_owned(),
            name,
            frequency_hz,
            truth: truth.cloned(),
            sheet_maps: SheetMaps::default(),
            snapshots: Vec::new(),
            files: Vec::new(),
            summary: None,
            point_beams: Vec::new(),
            needs_free_disk: false,
        })
    }

    /// Leaves a part of the disk free for the state and the raw archive, which may be on the same disk.
    pub(super) fn with_free_disk(self) -> Self {
        Self { needs_free_disk: true, ..self }
    }

    /// Returns an error if less than 1 / [`FREE_DIVISOR`] of the disk is free. Final maps are exempt, as no data follow them.
    fn require_free_disk(&self, solution: &Solution) -> Result<(), ProductsError> {
        let is_limited = self.needs_free_disk && !solution.is_final;
        match disk_space(&self.root).filter(|_| is_limited) {
            Some([free, size]) if free < size / FREE_DIVISOR => {
                let reason = "less than a twentieth of the disk is free, which is reserved for the state and the raw archive";
                let source = std::io::Error::new(std::io::ErrorKind::StorageFull, reason);
                Err(ProductsError::Write { path: self.root.clone(), source })
            }
            _ => Ok(()),
        }
    }

    /// Whether there is a map, of this run or an earlier one.
    fn has_map(&self) -> bool {
        ["map.fits", LATEST_MAP].iter().any(|name| self.root.join(&self.name).join(name).exists())
    }

    /// Writes a final map that was interrupted, which says so, without all that its equations do not give. It replaces no other map.
    fn write_interrupted(&mut self, shown: &ShownMaps, origin: Origin<'_>) -> Result<(), ProductsError> {
        self.summary = Some(self.summarise(origin.solution, shown, None));
        if self.has_map() {
            return Ok(());
        }
        for name in ["map.fits", LATEST_MAP] {
            self.write_described_map(name, &map_name(origin.solution), &shown.map, None, origin)?;
        }
        if self.config.pictures {
            self.draw_map(shown, origin)?;
        }
        Ok(())
    }

    /// Writes the products of one solution, and all products if it is final.
    ///
    /// If the files cannot be written, viewers still get the map, but the summary has no entry for it.
    pub(super) fn publish(
        &mut self,
        solution: &Solution,
        provenance: &Provenance,
        viewers: &MapWatch,
    ) -> Result<(), ProductsError> {
        let (snapshots, beams, files) = (self.snapshots.len(), self.point_beams.len(), self.files.len());
        let published = self.write_products(solution, provenance, viewers);
        if published.is_err() {
            // There is a new entry of `snapshots` if the map itself is valid and only its files could not be written.
            if self.snapshots.len() > snapshots {
                self.show(None, Origin { provenance, solution }, viewers);
            }
            self.snapshots.truncate(snapshots);
            self.point_beams.truncate(beams);
            self.files.truncate(files);
        }
        published
    }

    fn write_products(
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
        if solution.is_interrupted {
            return self.write_interrupted(&solved, origin);
        }
        let processed =
            self.config.processing().map(|processing| solved.processed(processing)).transpose()?;
        let shown = processed.as_ref().unwrap_or(&solved);
        let comparison = self.compare(solution, shown)?;
        self.record_snapshot(solution, shown, comparison.as_ref());
        self.require_free_disk(solution)?;
        if self.config.snapshot_maps && !solution.is_final {
            let name = format!("{}.fits", map_name(solution));
            self.write_map(&name, &solved.map, None, origin)?;
        }
        if self.config.pictures {
            self.sheet_maps.offer(shown.map.values(), &caption(solution));
            self.draw_snapshot(solution, shown)?;
        }
        self.write_described_map(LATEST_MAP, &map_name(solution), &solved.map, None, origin)?;
        if solution.is_final {
            for maps in [Some(&solved), processed.as_ref()].into_iter().flatten() {
                self.write_final(maps, origin)?;
            }
            self.write_errors(origin)?;
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

    fn show(&self, comparison: Option<&Comparison>, origin: Origin<'_>, viewers: &MapWatch) {
        let Origin { provenance, solution } = origin;
        let Some(figures) = self.snapshots.last() else { return };
        viewers.offer(|viewer| {
            let cards = provenance.cards(solution, &map_name(solution), None);
            let input = self.input(None).map(|input| &input.map);
            viewer.view(PublishedMap { solution, figures, cards: &cards, comparison, input });
        });
    }

    /// The input sky, processed like the maps with which it is compared.
    fn input(&self, processing: Option<PostProcessing>) -> Option<&InputSky> {
        let truth = self.truth.as_ref()?;
        if processing.is_some() { truth.processed.as_ref() } else { Some(&truth.plain) }
    }

    fn compare(&self, solution: &Solution, shown: &ShownMaps) -> Result<Option<Comparison>, ProductsError> {
        let Some(input) = self.input(shown.processing) else { return Ok(None) };
        // A harmonic map has no power above its l_max, and splitting pixels adds no degrees.
        let l_max = solution.diagnostics.l_max.unwrap_or(3 * solution.nside - 1);
        let comparison = compare_with(&shown.map, input, Some(&shown.noise), Some(l_max))?;
        let is_noisy = !solution.instrument.noiseless;
        Ok(Some(if is_noisy { comparison.with_noise_subtracted() } else { comparison }))
    }

    /// The summary; `None` if there was no final map.
    pub(super) fn summary(&self) -> Option<ChannelSummary> {
        self.summary.clone().map(|summary| ChannelSummary { files: self.files.clone(), ..summary })
    }

    /// The files that it has written, relative to the folder of all channels.
    pub(super) fn files(&self) -> &[String] {
        &self.files
    }

    fn record_snapshot(&mut self, solution: &Solution, shown: &ShownMaps, comparison: Option<&Comparison>) {
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
        let (pixels, uncertainty) = (solution.map_k.len() as f64, solution.uncertainty.as_ref());
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
            mean_sigma_k: uncertainty.map(|found| found.mean_sigma_k),
            dipole_k: uncertainty.map(|found| found.dipole_k),
            dipole_sigma_k: uncertainty.map(|found| found.dipole_sigma_k),
            sky_power: uncertainty.map(|found| found.power.clone()),
            errors_low_by: uncertainty
                .and_then(|found| errors_low_by(&found.power, &solution.diagnostics, solution.visibilities)),
            gain_errors: uncertainty.and_then(|found| found.gains.clone()),
            interrupted: solution.interruption(),
            noise_rms_k: match solution.is_interrupted {
                true => f64::NAN,
                false => (solution.noise_k.iter().map(|x| x * x).sum::<f64>() / pixels).sqrt(),
            },
            diagnostics: solution.diagnostics,
            refinement: solution.refinement.clone(),
            movers: solution.movers.clone(),
            snapshots: self.snapshots.clone(),
            thermal_noise: !solution.instrument.noiseless,
            post_processing: self.config.processing(),
            rho,
            rho_noise_subtracted,
            snr,
            power,
            beam,
            point_beams: self.point_beams.clone(),
            latitudes,
            files: Vec::new(),
        }
    }

    /// Adds a file of the channel's folder to the list in the summary; returns its path.
    fn register_file(&mut self, name: &str) -> PathBuf {
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
        self.write_described_map(name, name.trim_end_matches(".fits"), map, processing, origin)
    }

    /// Writes a map; `what` is its description in the header.
    fn write_described_map(
        &mut self,
        name: &str,
        what: &str,
        map: &SkyMap,
        processing: Option<PostProcessing>,
        Origin { provenance, solution }: Origin<'_>,
    ) -> Result<(), ProductsError> {
        let cards = provenance.cards(solution, what, processing);
        let options = WriteOptions { cards, ..WriteOptions::default() };
        let path = self.register_file(name);
        Ok(write_map(&path, map, &options)?)
    }

    /// Writes the maps of sky, noise and input, as solved or post-processed.
    fn write_final(&mut self, maps: &ShownMaps, origin: Origin<'_>) -> Result<(), ProductsError> {
        let &ShownMaps { ref map, ref noise, processing } = maps;
        let ending = if processing.is_some() { "-smooth" } else { "" };
        self.write_map(&format!("map{ending}.fits"), map, processing, origin)?;
        self.write_map(&format!("noise{ending}.fits"), noise, processing, origin)?;
        if let Some(input) = self.input(processing).map(|input| input.map.clone()) {
            self.write_map(&format!("input{ending}.fits"), &input, processing, origin)?;
        }
        Ok(())
    }

    /// Writes what belongs to the solution, not to its post-processing: errors by pixel, the sky's power, residuals, bodies that move.
    fn write_errors(&mut self, origin: Origin<'_>) -> Result<(), ProductsError> {
        if let Some(errors) = &origin.solution.uncertainty {
            for map in ErrorMap::all(errors) {
                let what = map.file.trim_end_matches(".fits");
                let mut cards = origin.provenance.cards(origin.solution, what, None);
                if map.file != "resolution.fits" {
                    let Solution { diagnostics, refinement, .. } = origin.solution;
                    cards.push(Card::text("ERRORS", limits(diagnostics, refinement.as_ref()), ""));
                    let visibilities = origin.solution.visibilities;
                    if let Some(factor) = errors_low_by(&errors.power, diagnostics, visibilities) {
                        cards.push(Card::real("ERRLOW", factor, "times too small, by the sky beyond l_max"));
                    }
                }
                self.register_file(map.file);
                map.write(&self.root.join(&self.name), &WriteOptions { cards, ..WriteOptions::default() })?;
            }
            write_product(&self.register_file("sky-power.csv"), errors.power.csv().as_bytes())?;
        }
        if let Some(refinement) = &origin.solution.refinement {
            write_product(&self.register_file("residuals.csv"), refinement.chi_square.csv().as_bytes())?;
        }
        if let Some(movers) = &origin.solution.movers {
            let table = movers.csv(self.frequency_hz);
            write_product(&self.register_file("movers.csv"), table.as_bytes())?;
        }
        Ok(())
    }

    /// Writes maps of the point beams, as solved and post-processed, and a table of their widths.
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
            self.point_beams.push(PointBeamSummary::new(beam.pixel, &map, l_max, processed.as_ref())?);
        }
        if !self.point_beams.is_empty() {
            write_product(&self.register_file("beams.csv"), beams_csv(&self.point_beams))?;
        }
        Ok(())
    }

    /// The colour scale shared by map and input, with the range of the input, or of the map if there is no input.
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
        let path = self.register_file(&format!("snapshot-{:03}.png", solution.number));
        // Half the size of the final picture, because there are many.
        let sheet =
            Sheet { title, subtitle, width_px: 800, view: view(self.config.frame), ..Sheet::default() };
        let picture = draw_sheet(&[panel], &sheet)?;
        picture.write(&path)?;
        // The final map has its own picture.
        if !solution.is_final {
            picture.write(&self.register_file(LATEST_PICTURE))?;
        }
        Ok(())
    }

    /// Draws a final map; returns the line below its title.
    fn draw_map(
        &mut self,
        shown: &ShownMaps,
        Origin { provenance, solution }: Origin<'_>,
    ) -> Result<String, ProductsError> {
        let how = provenance.caption(solution);
        let subtitle = format!("{} visibilities, {}; {how}", solution.visibilities, shown.resolution_text());
        let warning = solution.interruption().map_or_else(String::new, |said| format!(", {said}"));
        let title = format!("Map at {} MHz{warning}", self.frequency_hz / 1e6);
        let panel = self.panel(shown.map.values(), &title, self.scale(shown));
        let picture = draw_map(&panel, &subtitle, &view(self.config.frame))?;
        self.write_picture("map", &picture)?;
        picture.write(&self.register_file(LATEST_PICTURE))?;
        Ok(subtitle)
    }

    fn draw_final(
        &mut self,
        shown: &ShownMaps,
        comparison: Option<&Comparison>,
        origin: Origin<'_>,
    ) -> Result<(), ProductsError> {
        let (solution, mhz) = (origin.solution, self.frequency_hz / 1e6);
        let (subtitle, scale) = (self.draw_map(shown, origin)?, self.scale(shown));
        if let Some(input) = self.input(shown.processing).cloned() {
            let panel = self.panel(input.map.values(), &format!("Input at {mhz} MHz"), scale);
            let picture = draw_map(&panel, &shown.resolution_text(), &view(self.config.frame))?;
            self.write_picture("input", &picture)?;
        }
        if let Some(comparison) = comparison {
            let title = format!("Relative error at {mhz} MHz");
            let picture = draw_relative_error(&title, &subtitle, comparison, self.config.frame)?;
            self.write_picture("error", &picture)?;
            let noise = if solution.instrument.noiseless { "without" } else { "with" };
            let title = format!("{mhz} MHz, {}, {noise} thermal noise", shown.resolution_text());
            self.write_picture("spectra", &draw_comparison(&title, comparison)?)?;
        }
        self.draw_sharpening(shown, &caption(solution), scale)
    }

    fn draw_sharpening(
        &mut self,
        last: &ShownMaps,
        caption: &str,
        scale: ColourScale,
    ) -> Result<(), ProductsError> {
        let shown = self.sheet_maps.evenly_spaced((last.map.values(), caption));
        let panels: Vec<MapPanel<'_>> = shown.map(|(map, caption)| self.panel(map, caption, scale)).collect();
        let sheet = Sheet {
            title: format!("Map at {} MHz by time observed", self.frequency_hz / 1e6),
            columns: 3,
            width_px: 1800,
            bars: Bars::Shared,
            view: view(self.config.frame),
            ..Sheet::default()
        };
        let picture = draw_sheet(&panels, &sheet)?;
        self.write_picture("sharpening", &picture)
    }

    /// Writes a final picture as PNG, and as SVG if configured.
    fn write_picture(&mut self, name: &str, picture: &Picture) -> Result<(), ProductsError> {
        let path = self.register_file(&format!("{name}.png"));
        picture.write(&path)?;
        if self.config.svg {
            let path = self.register_file(&format!("{name}.svg"));
            picture.write(&path)?;
        }
        Ok(())
    }
}

#[derive(Clone, Copy)]
struct Origin<'a> {
    provenance: &'a Provenance,
    solution: &'a Solution,
}

/// A map and its noise-only map, as solved or post-processed.
struct ShownMaps {
    map: SkyMap,
    noise: SkyMap,
    /// The processing; `None` for maps as solved.
    processing: Option<PostProcessing>,
}

impl ShownMaps {
    fn processed(&self, processing: PostProcessing) -> Result<Self, ProductsError> {
        let apply = |map: &SkyMap| processing.apply(map);
        Ok(Self { map: apply(&self.map)?, noise: apply(&self.noise)?, processing: Some(processing) })
    }

    fn resolution_text(&self) -> String {
        let nside = self.map.nside();
        match self.processing {
            None => format!("nside {nside}"),
            Some(PostProcessing { split, fwhm_deg }) => {
                format!("nside {} split to {nside}, FWHM {fwhm_deg} deg", nside / split)
            }
        }
    }
}

fn map_name(solution: &Solution) -> String {
    if solution.is_final { "map".to_owned() } else { format!("snapshot-{:03}", solution.number) }
}

fn caption(solution: &Solution) -> String {
    format!("after {:.0} days", (solution.span_s[1] - solution.span_s[0]) / DAY_S)
}

/// The view of a map, which is on ecliptic axes, in a celestial frame.
fn view(frame: Frame) -> View {
    View { sampling: Sampling::Interpolated, ..View::of(frame, Frame::Ecliptic) }
}

fn rms_error_over_rms_truth(map: &[f64], truth: &[f64]) -> f64 {
    let difference: f64 = map.iter().zip(truth).map(|(m, t)| (m - t) * (m - t)).sum();
    let scale: f64 = truth.iter().map(|t| t * t).sum();
    (difference / scale).sqrt()
}

fn mean_rho(rho: &[f64], l_max: usize) -> f64 {
    let range = &rho[1.min(rho.len())..rho.len().min(l_max + 1)];
    range.iter().sum::<f64>() / range.len().max(1) as f64
}
