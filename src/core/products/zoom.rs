//! The products of a zoom: images with a celestial coordinate system, a picture, and tables of sources.

use std::fmt::Write;
use std::path::Path;

use serde::Serialize;

use super::error::ProductsError;
use super::pictures::{BeamMark, ColourScale, Palette, Patch as PatchPicture, Scaling, draw_patches};
use crate::files::write_atomically;
use crate::imaging::zoom::{ImageNoise, Patch, PointSource, SmoothReport, Zoom, ZoomBeam, place_errors};
use crate::numerics::{SIGMA_OF_MEDIAN, median};
use crate::sky::fits::{Card, image_bytes};
use crate::sky::{Cutout, Frame, PlaneProjection};
use crate::units::Dimension;
use crate::units::vector::{Vec3, dot};

/// Side of the squares in which noise is measured, in beams.
const NOISE_BEAMS: f64 = 40.0;
/// Pixels of the picture.
const PICTURE_PIXELS: usize = 600;
/// Greatest distance of a source from the one that it is identified with, in beams.
const SAME_BEAMS: f64 = 1.0;

/// A source that is known otherwise, for identification.
#[derive(Clone, Debug, PartialEq)]
pub struct ListedSource {
    /// Name.
    pub name: String,
    /// Direction, on ecliptic axes.
    pub direction: Vec3,
    /// Flux density at the frequency of the image, Jy.
    pub flux_jy: f64,
}

/// A found source.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SourceEntry {
    /// Name: the number by brightness, from 1.
    pub id: usize,
    /// Right ascension (J2000), degrees.
    pub ra_deg: f64,
    /// Declination (J2000), degrees.
    pub dec_deg: f64,
    /// Standard deviation towards east, arcsec.
    pub east_error_arcsec: f64,
    /// Standard deviation towards north, arcsec.
    pub north_error_arcsec: f64,
    /// Flux density, Jy.
    pub flux_jy: f64,
    /// Standard deviation of the flux density, Jy.
    pub flux_error_jy: f64,
    /// Name of the known source within a beam; empty if there is none.
    pub known_name: String,
    /// Its flux density, Jy; `None` if there is none.
    pub known_flux_jy: Option<f64>,
    /// Its distance, arcsec.
    pub known_distance_arcsec: Option<f64>,
}

/// What a zoom is of, and what it found.
#[derive(Clone, Debug, Serialize)]
pub struct ZoomSummary {
    /// Right ascension and declination of the centre (J2000), degrees.
    pub centre_deg: [f64; 2],
    /// Radius, degrees.
    pub radius_deg: f64,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Side of a pixel, arcmin.
    pub pixel_arcmin: f64,
    /// Pixels along a side.
    pub side_pixels: usize,
    /// Shortest and longest baseline that was used, wavelengths; `None` for no limit.
    pub baselines_wavelengths: [Option<f64>; 2],
    /// Averages of visibilities.
    pub rows: usize,
    /// The beam.
    pub beam: ZoomBeam,
    /// Noise of the residual image.
    pub noise: ImageNoise,
    /// Factor by which sources exceed the noise at least.
    pub threshold: f64,
    /// Expected number of sources that are noise.
    pub false_sources: f64,
    /// Sources.
    pub sources: Vec<SourceEntry>,
    /// The map of what the sources leave; `None` if that is noise.
    pub smooth: Option<SmoothReport>,
}

impl ZoomSummary {
    /// The summary of a zoom, with sources identified with those of a list.
    #[must_use]
    pub fn new(
        zoom: &Zoom,
        patch: &Patch,
        centre_deg: [f64; 2],
        (frequency_hz, limits, rows): (f64, [Option<f64>; 2], usize),
        listed: &[ListedSource],
    ) -> Self {
        let entries = zoom.found.sources.iter().zip(1..);
        let sources = entries.map(|(source, id)| entry(zoom, patch, source, id, listed)).collect();
        Self {
            centre_deg,
            radius_deg: patch.radius_rad().to_degrees(),
            frequency_hz,
            pixel_arcmin: 60.0 * zoom.grid.step.to_degrees(),
            side_pixels: zoom.grid.side,
            baselines_wavelengths: limits,
            rows,
            beam: zoom.beam,
            noise: zoom.found.noise,
            threshold: zoom.found.threshold,
            false_sources: zoom.found.false_sources,
            sources,
            smooth: zoom.smooth.as_ref().map(|smooth| smooth.report),
        }
    }

    /// The sources as a table (CSV).
    #[must_use]
    pub fn csv(&self) -> String {
        let mut text = "id,ra_deg,dec_deg,east_error_arcsec,north_error_arcsec,flux_jy,flux_error_jy,known_name,known_flux_jy,known_distance_arcsec\n".to_owned();
        for one in &self.sources {
            let name = match one.known_name.contains([',', '"']) {
                true => format!("\"{}\"", one.known_name.replace('"', "\"\"")),
                false => one.known_name.clone(),
            };
            let number = |value: Option<f64>| value.map(|value| format!("{value:.4}")).unwrap_or_default();
            // Writing to a string cannot fail.
            let _ = writeln!(
                text,
                "{},{:.7},{:.7},{:.3},{:.3},{:.4},{:.4},{name},{},{}",
                one.id,
                one.ra_deg,
                one.dec_deg,
                one.east_error_arcsec,
                one.north_error_arcsec,
                one.flux_jy,
                one.flux_error_jy,
                number(one.known_flux_jy),
                number(one.known_distance_arcsec),
            );
        }
        text
    }

    /// The sources as a VOTable 1.4.
    #[must_use]
    pub fn votable(&self) -> String {
        const FIELDS: [(&str, &str, &str, &str); 10] = [
            ("id", "int", "", "meta.id;meta.main"),
            ("ra_deg", "double", "deg", "pos.eq.ra;meta.main"),
            ("dec_deg", "double", "deg", "pos.eq.dec;meta.main"),
            ("east_error_arcsec", "double", "arcsec", "stat.error;pos.eq.ra"),
            ("north_error_arcsec", "double", "arcsec", "stat.error;pos.eq.dec"),
            ("flux_jy", "double", "Jy", "phot.flux.density;em.radio"),
            ("flux_error_jy", "double", "Jy", "stat.error;phot.flux.density"),
            ("known_name", "char", "", "meta.id.cross"),
            ("known_flux_jy", "double", "Jy", "phot.flux.density"),
            ("known_distance_arcsec", "double", "arcsec", "pos.angDistance"),
        ];
        let mut text = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<VOTABLE version=\"1.4\" xmlns=\"http://www.ivoa.net/xml/VOTable/v1.3\">\n<RESOURCE>\n\
                        <COOSYS ID=\"J2000\" system=\"eq_FK5\" equinox=\"J2000\"/>\n<TABLE name=\"sources\">\n"
            .to_owned();
        for (name, kind, unit, ucd) in FIELDS {
            let size = if kind == "char" { " arraysize=\"*\"" } else { "" };
            let unit = if unit.is_empty() { String::new() } else { format!(" unit=\"{unit}\"") };
            let frame = if ucd.ends_with("meta.main") && name != "id" { " ref=\"J2000\"" } else { "" };
            let _ = writeln!(
                text,
                "<FIELD name=\"{name}\" datatype=\"{kind}\"{size}{unit} ucd=\"{ucd}\"{frame}/>"
            );
        }
        text.push_str("<DATA><TABLEDATA>\n");
        for one in &self.sources {
            let name = one.known_name.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
            let name: String = name.chars().filter(|c| !c.is_control()).collect();
            let number = |value: Option<f64>| value.map(|value| value.to_string()).unwrap_or_default();
            let _ = writeln!(
                text,
                "<TR><TD>{}</TD><TD>{}</TD><TD>{}</TD><TD>{}</TD><TD>{}</TD><TD>{}</TD><TD>{}</TD><TD>{name}</TD><TD>{}</TD><TD>{}</TD></TR>",
                one.id,
                one.ra_deg,
                one.dec_deg,
                one.east_error_arcsec,
                one.north_error_arcsec,
                one.flux_jy,
                one.flux_error_jy,
                number(one.known_flux_jy),
                number(one.known_distance_arcsec),
            );
        }
        text.push_str("</TABLEDATA></DATA>\n</TABLE>\n</RESOURCE>\n</VOTABLE>\n");
        text
    }
}

/// A source with its errors, and the listed source nearest to it within a beam.
fn entry(
    zoom: &Zoom,
    patch: &Patch,
    source: &PointSource,
    id: usize,
    listed: &[ListedSource],
) -> SourceEntry {
    // What the weights do not know of, such as sources outside the patch, is in the noise of the image.
    let excess = zoom.found.noise.sigma_jy() / zoom.found.noise.thermal_jy;
    let arcsec = |rad: f64| 3600.0 * rad.to_degrees();
    let (errors, _) = place_errors(&zoom.sums, source);
    let [east, north] = errors.map(|error| arcsec(excess * error));
    let [ra_deg, dec_deg] = patch.equatorial_deg(source.place);
    let distance = |one: &ListedSource| {
        let [l, m, n] = patch.on_axes(one.direction);
        let apart = (l - source.place[0]).hypot(m - source.place[1]);
        if n > 0.0 { apart } else { f64::INFINITY }
    };
    let nearest = listed.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    let known = nearest.filter(|one| distance(one) < SAME_BEAMS * zoom.beam.fwhm_rad());
    SourceEntry {
        id,
        ra_deg,
        dec_deg,
        east_error_arcsec: east,
        north_error_arcsec: north,
        flux_jy: source.flux_jy,
        flux_error_jy: zoom.found.noise.sigma_jy(),
        known_name: known.map(|one| one.name.clone()).unwrap_or_default(),
        known_flux_jy: known.map(|one| one.flux_jy),
        known_distance_arcsec: known.map(|one| arcsec(distance(one))),
    }
}

/// Writes the images `image.fits` (sources with the beam's width, and the residual), `residual.fits`, `sigma.fits` (noise), `beam.fits`,
/// and, if the sources leave more than noise, `smooth.fits`; the picture `image.png`; `sources.csv` and `sources.vot`.
///
/// # Errors
/// Files that cannot be written.
pub fn write_zoom(
    folder: &Path,
    zoom: &Zoom,
    summary: &ZoomSummary,
    cards: &[Card],
) -> Result<(), ProductsError> {
    let grid = &zoom.grid;
    let mut image = zoom.found.image_jy.clone();
    zoom.beam.add_to(grid, &zoom.found.sources, &mut image);
    let sigma = local_sigma(zoom);
    let smooth = zoom
        .smooth
        .as_ref()
        .map(|smooth| ("smooth", &smooth.pixel_jy, "Jy/pixel", "regularised map of the residual"));
    let images = [
        ("image", &image, "Jy/beam", "sources as Gaussian beams, and the residual"),
        ("residual", &zoom.found.image_jy, "Jy/beam", "dirty image less the sources"),
        ("sigma", &sigma, "Jy/beam", "noise of the residual"),
        ("beam", &zoom.beam_image, "", "dirty image of 1 Jy at the centre"),
    ];
    for (name, values, unit, content) in images.into_iter().chain(smooth) {
        let all: Vec<Card> = [
            Card::text("CONTENT", content, "what the image shows"),
            Card::text("BUNIT", unit, "unit of the values"),
        ]
        .into_iter()
        .chain(coordinates(summary))
        .chain(cards.iter().cloned())
        .collect();
        let bytes = image_bytes(grid.side, &rows_from_top(zoom, values), &all)?;
        write(&folder.join(format!("{name}.fits")), &bytes)?;
    }
    write(&folder.join("sources.csv"), summary.csv().as_bytes())?;
    write(&folder.join("sources.vot"), summary.votable().as_bytes())?;
    picture(zoom, summary, &image)?.write(&folder.join("image.png"))?;
    Ok(())
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), ProductsError> {
    write_atomically(path, bytes).map_err(|source| ProductsError::Write { path: path.to_owned(), source })
}

/// Cards of the celestial coordinates: direction cosines are the orthographic projection SIN.
fn coordinates(summary: &ZoomSummary) -> Vec<Card> {
    let middle = (summary.side_pixels / 2 + 1) as f64;
    let step_deg = summary.pixel_arcmin / 60.0;
    let ZoomBeam { fwhm_major_arcmin, fwhm_minor_arcmin, angle_deg } = summary.beam;
    vec![
        Card::text("CTYPE1", "RA---SIN", "right ascension, orthographic"),
        Card::text("CTYPE2", "DEC--SIN", "declination, orthographic"),
        Card::real("CRPIX1", middle, "pixel of the centre"),
        Card::real("CRPIX2", middle, "pixel of the centre"),
        Card::real("CRVAL1", summary.centre_deg[0], "[deg] right ascension of the centre"),
        Card::real("CRVAL2", summary.centre_deg[1], "[deg] declination of the centre"),
        Card::real("CDELT1", -step_deg, "[deg] a pixel"),
        Card::real("CDELT2", step_deg, "[deg] a pixel"),
        Card::text("CUNIT1", "deg", ""),
        Card::text("CUNIT2", "deg", ""),
        Card::real("LONPOLE", 180.0, "[deg] north is up at any declination"),
        Card::text("RADESYS", "FK5", ""),
        Card::real("EQUINOX", 2000.0, ""),
        Card::real("BMAJ", fwhm_major_arcmin / 60.0, "[deg] beam, major axis"),
        Card::real("BMIN", fwhm_minor_arcmin / 60.0, "[deg] beam, minor axis"),
        Card::real("BPA", angle_deg, "[deg] beam, angle from north to east"),
        Card::real("FREQ", summary.frequency_hz, "[Hz] centre frequency"),
    ]
}

/// Rows of an image from the top, NaN outside the patch.
fn rows_from_top(zoom: &Zoom, values: &[f64]) -> Vec<f32> {
    let side = zoom.grid.side;
    let at = |k: usize| {
        let index = k % side * side + (side - 1 - k / side);
        if zoom.grid.is_inside(index) { values[index] as f32 } else { f32::NAN }
    };
    (0..side * side).map(at).collect()
}

/// Noise of the residual in squares of some beams by the median of the moduli, at least that of the weights.
fn local_sigma(zoom: &Zoom) -> Vec<f64> {
    let grid = &zoom.grid;
    let square = ((NOISE_BEAMS * zoom.beam.fwhm_rad() / grid.step) as usize).clamp(1, grid.side);
    let squares = grid.side.div_ceil(square);
    let number = |index: usize| index / grid.side / square * squares + index % grid.side / square;
    let mut moduli: Vec<Vec<f64>> = vec![Vec::new(); squares * squares];
    for index in (0..grid.len()).filter(|&index| grid.is_inside(index)) {
        moduli[number(index)].push(zoom.found.image_jy[index].abs());
    }
    let thermal = zoom.found.noise.thermal_jy;
    let sigma = |values| median(values).map_or(thermal, |median| (SIGMA_OF_MEDIAN * median).max(thermal));
    let sigma: Vec<f64> = moduli.into_iter().map(sigma).collect();
    (0..grid.len()).map(|index| sigma[number(index)]).collect()
}

/// The image in gnomonic projection, with the beam and a bar of a whole length.
fn picture(
    zoom: &Zoom,
    summary: &ZoomSummary,
    image: &[f64],
) -> Result<super::pictures::Picture, ProductsError> {
    let reach = zoom.grid.reach.asin().tan();
    let cutout = Cutout {
        projection: PlaneProjection::Gnomonic,
        frame: Frame::Equatorial,
        centre_deg: summary.centre_deg,
        size_deg: 2.0 * reach.to_degrees(),
        pixels: PICTURE_PIXELS,
    };
    let grid = &zoom.grid;
    let width = 2.0 * reach / PICTURE_PIXELS as f64;
    // The pixels of a cell of the picture: the one that is farthest from 0 is shown, so that no source is lost.
    let part = (width / grid.step).ceil().max(1.0) as usize;
    let value = |k: usize| {
        let at = |k: usize, j: usize| {
            (k as f64 + (j as f64 + 0.5) / part as f64 - 0.5 * PICTURE_PIXELS as f64) * width
        };
        let pixels = (0..part * part).filter_map(|j| {
            let (right, up) = (at(k % PICTURE_PIXELS, j % part), at(k / PICTURE_PIXELS, j / part));
            let n = dot([1.0, right, up], [1.0, right, up]).sqrt().recip();
            let index = |x: f64| (x / grid.step).round() as i64 + (grid.side / 2) as i64;
            let (column, row) = (index(right * n), index(up * n));
            let inside = |k: i64| (0..grid.side as i64).contains(&k);
            let index = column as usize * grid.side + row as usize;
            (inside(column) && inside(row) && grid.is_inside(index)).then(|| image[index])
        });
        pixels.max_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap_or(f64::NAN)
    };
    let values: Vec<f64> = (0..PICTURE_PIXELS * PICTURE_PIXELS).map(value).collect();
    let sigma = zoom.found.noise.sigma_jy();
    let brightest = zoom.found.sources.first().map_or(0.0, |source| source.flux_jy);
    let top = (0.5 * brightest).max(8.0 * sigma);
    let scale = ColourScale::new(-3.0 * sigma, top, Scaling::Linear, Palette::Inferno)?;
    let patch = PatchPicture {
        caption: format!(
            "{}, {} sources",
            Dimension::Frequency.show(summary.frequency_hz),
            summary.sources.len()
        ),
        cutout,
        values: &values,
        scale,
        unit: "Jy/beam".to_owned(),
        beam: Some(BeamMark {
            major_deg: summary.beam.fwhm_major_arcmin / 60.0,
            minor_deg: summary.beam.fwhm_minor_arcmin / 60.0,
            angle_deg: summary.beam.angle_deg,
        }),
    };
    Ok(draw_patches("", &[patch], 1)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_hold_names_that_are_awkward() {
        let entry = SourceEntry {
            id: 1,
            ra_deg: 10.0,
            dec_deg: -20.0,
            east_error_arcsec: 1.0,
            north_error_arcsec: 2.0,
            flux_jy: 5.0,
            flux_error_jy: 0.5,
            known_name: "a, \"b\" & <c>".to_owned(),
            known_flux_jy: None,
            known_distance_arcsec: None,
        };
        let beam = ZoomBeam { fwhm_major_arcmin: 2.0, fwhm_minor_arcmin: 1.0, angle_deg: 0.0 };
        let summary = ZoomSummary {
            centre_deg: [10.0, -20.0],
            radius_deg: 1.0,
            frequency_hz: 1e7,
            pixel_arcmin: 0.5,
            side_pixels: 10,
            baselines_wavelengths: [None; 2],
            rows: 1,
            beam,
            noise: ImageNoise { thermal_jy: 1.0, measured_jy: 1.0 },
            threshold: 5.0,
            false_sources: 0.0,
            sources: vec![entry],
            smooth: None,
        };
        assert!(summary.csv().contains(",\"a, \"\"b\"\" & <c>\",,\n"), "{}", summary.csv());
        assert!(summary.votable().contains("<TD>a, \"b\" &amp; &lt;c&gt;</TD>"));
    }
}
