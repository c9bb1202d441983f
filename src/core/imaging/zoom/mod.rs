//! A patch of sky at the array's own resolution, from baselines of any length and direction.
//!
//! [`Averager`] turns each visibility to the patch's centre and averages tracks while the patch's edge hardly turns: some ten times fewer
//! rows. [`PatchTransform`] goes between rows and pixels. Sources are found without pixels ([`PatchData::find`]); what they leave is
//! a regularised map. [`zoom`] does it all.

mod averaging;
mod beam;
mod find;
mod patch;
mod points;
mod smooth;
mod transform;

pub use averaging::{Averager, AveragingCounts, AveragingSetup, KnownSource, Row};
pub use beam::ZoomBeam;
pub use find::{FoundSources, ImageNoise, PatchData};
pub use patch::{Patch, PatchView};
pub use points::{PointSource, RowSums};
pub use smooth::{SmoothMap, SmoothReport};
pub use transform::{PatchTransform, PixelGrid};

/// Pixels for each turn of the fringe of the longest baseline, by default.
const PIXELS_PER_TURN: f64 = 3.0;

/// Maximum pixels along a side: some 10 GB of grids.
const SIDE_MAX: usize = 12_000;

/// The images and sources of a patch.
#[derive(Clone, Debug)]
pub struct Zoom {
    /// Pixels of the images.
    pub grid: PixelGrid,
    /// Sums of the rows.
    pub sums: RowSums,
    /// Width of the beam.
    pub beam: ZoomBeam,
    /// The beam: the image of a source of 1 Jy at the centre.
    pub beam_image: Vec<f64>,
    /// Sources and residual image.
    pub found: FoundSources,
    /// Map of what the sources leave; `None` if that is noise.
    pub smooth: Option<SmoothMap>,
}

/// Why a patch could not be imaged.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ZoomError {
    /// No visibility is left.
    #[error(
        "no visibility sees the whole patch between the shortest and the longest baseline; expected data from the patch's side of the \
         Moon, and limits that leave some. {0}"
    )]
    NoRows(AveragingCounts),
    /// The pixels are too large for the baselines.
    #[error(
        "pixels of {found_arcmin:.3} arcmin are too large for baselines of {wavelengths:.0} wavelengths; expected at most \
         {most_arcmin:.3} arcmin, or a lower limit of baselines"
    )]
    Pixel {
        /// Side of a pixel, arcmin.
        found_arcmin: f64,
        /// Greatest side, arcmin.
        most_arcmin: f64,
        /// Longest baseline.
        wavelengths: f64,
    },
    /// Too many pixels.
    #[error(
        "{side} pixels along a side of the patch: expected at most {SIDE_MAX}; choose a smaller radius, larger pixels, or shorter baselines"
    )]
    Size {
        /// Pixels along a side.
        side: usize,
    },
    /// All baselines are along one line.
    #[error("the beam has no width: expected baselines in more than one direction across the patch")]
    NoBeam,
}

/// Images a patch from its rows, with pixels of a side in arcmin (`None`: a third of the longest baseline's fringe).
///
/// # Errors
/// [`ZoomError`]: nothing to image, or pixels that do not fit.
pub fn zoom(
    (rows, counts): (&[Row], AveragingCounts),
    patch: &Patch,
    pixel_arcmin: Option<f64>,
) -> Result<Zoom, ZoomError> {
    let across = |row: &Row| {
        let [u, v, _]: [f64; 3] = std::array::from_fn(|k| row.u[k].abs() + row.spread[k].abs());
        u.hypot(v)
    };
    let longest = rows.iter().map(across).fold(0.0, f64::max);
    if longest <= 0.0 {
        return Err(ZoomError::NoRows(counts));
    }
    let arcmin = |rad: f64| 60.0 * rad.to_degrees();
    let step = match pixel_arcmin {
        None => 1.0 / (PIXELS_PER_TURN * longest),
        Some(found_arcmin) => {
            let most_arcmin = arcmin(0.5 / longest);
            if found_arcmin > most_arcmin {
                return Err(ZoomError::Pixel { found_arcmin, most_arcmin, wavelengths: longest });
            }
            found_arcmin.to_radians() / 60.0
        }
    };
    let grid = PixelGrid::new(patch.radius_rad(), step);
    if grid.side > SIDE_MAX {
        return Err(ZoomError::Size { side: grid.side });
    }
    let sums = RowSums::new(rows);
    let beam = ZoomBeam::measure(rows, &sums).ok_or(ZoomError::NoBeam)?;
    let transform = PatchTransform::new(grid, rows);
    let data = PatchData { rows, sums, transform: &transform, beam: beam.fwhm_rad() };
    let beam_image = data.image_jy(&vec![num_complex::Complex64::ONE; rows.len()]);
    let found = data.find();
    let smooth = data.smooth_map(&found.image_jy, &beam_image);
    Ok(Zoom { grid, sums, beam, beam_image, found, smooth })
}

/// Standard deviations of a source's place towards east and north, rad, and their correlation.
#[must_use]
pub fn place_errors(sums: &RowSums, source: &PointSource) -> ([f64; 2], f64) {
    let [[ll, lm], [_, mm]] = sums.covariance(source);
    ([ll.sqrt(), mm.sqrt()], lm / (ll * mm).sqrt())
}
