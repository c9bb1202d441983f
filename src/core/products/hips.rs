//! Writes maps as HiPS (Hierarchical Progressive Surveys, IVOA Recommendation 1.0), for example for Aladin.
//!
//! The sky is divided into the HEALPix pixels of an order, each a tile of `width` by `width` HEALPix pixels of a higher order, in
//! `NorderK/DirD/NpixN.fits` and `.png`. A tile's first row from the top begins at the southern corner: rows go to the north-east
//! (x of the NESTED scheme), columns to the north-west (y). `Norder3/Allsky` has all tiles of order 3, 27 in a row.
//!
//! Tiles of the highest order take the value of the map at the centre of each of their pixels, without interpolation; those of
//! lower orders are means of four pixels below.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::Serialize;

use super::error::ProductsError;
use super::pictures::{ColourScale, Palette, Scaling, tile_png};
use crate::files::{FolderLock, write_atomically};
use crate::sky::fits::{Card, image_bytes};
use crate::sky::healpix::{face_direction, nested_to_face, pixel_of};
use crate::sky::{Frame, Rotation, SkyMap, is_unseen, rotate};
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// The lowest order that every HiPS must have. Clients show its tiles first.
const ORDER_MIN: u8 = 3;
/// Minimum and maximum width of tiles. 512 is the standard, and 64 is used for published maps of nside 512 (WMAP). Clients cache
/// hundreds of tiles, so that smaller ones save little.
const WIDTHS: [usize; 2] = [64, 512];
const PREVIEW_WIDTH: usize = 64;
const PREVIEW_TILES: usize = 768;
const PREVIEW_COLUMNS: usize = 27;
/// Name of the lock file of a folder that is being written. An interrupted export leaves it as a mark that its tiles may be
/// replaced.
const UNFINISHED: &str = ".lunarray-hips";

/// Options for writing a map as HiPS.
#[derive(Clone, Debug, PartialEq)]
pub struct Hips {
    /// Frame of the tiles.
    pub frame: Frame,
    /// Scale of the colours.
    pub scaling: Scaling,
    /// Title in one line.
    pub title: String,
    /// Identifier in the Virtual Observatory, such as `ivo://AUTHORITY/P/NAME`.
    pub id: String,
    /// Date of the map, as `YYYY-mm-ddTHH:MMZ`.
    pub date: String,
    /// Frequency of the map, Hz.
    pub frequency_hz: Option<f64>,
}

/// Report on a HiPS that was written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HipsReport {
    /// Highest order of tiles.
    pub order: u8,
    /// Pixels along a side of a tile.
    pub tile_width: usize,
    /// Frame of the tiles.
    pub frame: Frame,
    /// Number of tiles of all orders, each as FITS and PNG.
    pub tiles: usize,
}

/// Values of a tile, K, row by row from the top; NaN for pixels without a value.
type Tile = Vec<f32>;

struct TileWriter<'a> {
    map: &'a SkyMap,
    /// Rotation from the frame of the tiles to that of the map.
    rotation: Rotation,
    same_frame: bool,
    scale: ColourScale,
    order: u8,
    width: usize,
    folder: &'a Path,
}

/// A written tile, with the results of all tiles within it.
struct TileSummary {
    tile: Tile,
    /// Reduced tiles of order 3 with their numbers.
    previews: Vec<(usize, Tile)>,
    count: usize,
}

impl Hips {
    /// Writes a map in K into a new or empty folder.
    ///
    /// The file `properties`, which every reader needs, is written last. Tiles without it are left from an interrupted export, and
    /// are replaced.
    ///
    /// # Errors
    /// A folder that is not empty, or in which files cannot be written; values beyond single precision.
    pub fn write(&self, map: &SkyMap, folder: &Path) -> Result<HipsReport, ProductsError> {
        let failed = ProductsError::write;
        fs::create_dir_all(folder).map_err(failed(folder))?;
        let properties = folder.join("properties");
        let mut existing = Vec::new();
        for entry in fs::read_dir(folder).map_err(failed(folder))? {
            existing.push(entry.map_err(failed(folder))?.path());
        }
        // An interrupted export leaves its lock file. Tiles without it were not written by this program.
        let begins = |path: &Path, start: &str| {
            path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(start))
        };
        let is_mark = |path: &&PathBuf| begins(path, UNFINISHED);
        let is_ours = existing.iter().any(|path| is_mark(&path));
        // The lock removes the beginning of `properties`.
        let is_left = |path: &&PathBuf| is_mark(path) || (is_ours && begins(path, ".properties."));
        let (tiles, others): (Vec<&PathBuf>, Vec<&PathBuf>) =
            existing.iter().filter(|path| !is_left(path)).partition(|path| begins(path, "Norder"));
        if !others.is_empty() || (!tiles.is_empty() && !is_ours) {
            return Err(ProductsError::NotEmpty { path: folder.to_owned() });
        }
        let _lock = FolderLock::acquire(folder, UNFINISHED, true).map_err(failed(folder))?;
        for path in tiles {
            fs::remove_dir_all(path).map_err(failed(path))?;
        }
        let depth = map.nside().trailing_zeros() as u8;
        let width = (map.nside() >> ORDER_MIN).clamp(WIDTHS[0], WIDTHS[1]);
        let order = depth.saturating_sub(width.trailing_zeros() as u8).max(ORDER_MIN);
        let tiles = TileWriter {
            map,
            rotation: self.frame.to_frame(map.frame()),
            same_frame: self.frame == map.frame(),
            scale: ColourScale::robust(map.values(), self.scaling, Palette::default()),
            order,
            width,
            folder,
        };
        let faces: Vec<TileSummary> =
            (0..12).into_par_iter().map(|face| tiles.write(0, face)).collect::<Result<_, _>>()?;
        let mut previews = Vec::new();
        let mut count = 0;
        for face in faces {
            previews.extend(face.previews);
            count += face.count;
        }
        tiles.write_preview(&previews)?;
        write_atomically(&properties, self.properties(&tiles).as_bytes()).map_err(failed(&properties))?;
        Ok(HipsReport { order, tile_width: width, frame: self.frame, tiles: count })
    }

    /// The contents of the file `properties`, with one key and value per line.
    fn properties(&self, tiles: &TileWriter<'_>) -> String {
        let seen = || tiles.map.values().iter().copied().filter(|value| !is_unseen(*value));
        let (low, high) = (seen().fold(f64::INFINITY, f64::min), seen().fold(f64::NEG_INFINITY, f64::max));
        let pixel_deg = (4.0 * std::f64::consts::PI / 12.0).sqrt().to_degrees()
            / (f64::from(1_u32 << tiles.order) * tiles.width as f64);
        let one_line = |text: &str| text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        let mut lines: Vec<(&str, String)> = vec![
            ("creator_did", one_line(&self.id)),
            ("obs_title", one_line(&self.title)),
            ("dataproduct_type", "image".into()),
            ("hips_version", "1.4".into()),
            ("hips_builder", concat!("lunarray ", env!("CARGO_PKG_VERSION")).into()),
            ("hips_release_date", self.date.clone()),
            ("hips_status", "public master clonableOnce".into()),
            (
                "hips_frame",
                match self.frame {
                    Frame::Ecliptic => "ecliptic",
                    Frame::Galactic => "galactic",
                    Frame::Equatorial => "equatorial",
                }
                .into(),
            ),
            ("hips_order_min", "0".into()),
            ("hips_order", tiles.order.to_string()),
            ("hips_tile_width", tiles.width.to_string()),
            ("hips_tile_format", "png fits".into()),
            ("hips_pixel_bitpix", "-32".into()),
            ("hips_pixel_scale", format!("{pixel_deg:.6}")),
            ("hips_pixel_cut", format!("{:e} {:e}", tiles.scale.low(), tiles.scale.high())),
            ("hips_data_range", format!("{low:e} {high:e}")),
            ("hips_sampling", "nearest".into()),
            ("hips_hierarchy", "mean".into()),
            ("hips_initial_fov", "180".into()),
            ("moc_sky_fraction", "1".into()),
            ("data_pixel_bitpix", "-32".into()),
            ("data_ucd", "phot.antennaTemp".into()),
            ("obs_regime", "Radio".into()),
        ];
        if let Some(wavelength_m) = self.frequency_hz.map(|hz| SPEED_OF_LIGHT_M_S / hz) {
            lines.push(("em_min", format!("{wavelength_m:e}")));
            lines.push(("em_max", format!("{wavelength_m:e}")));
        }
        lines.iter().fold(String::new(), |mut text, (key, value)| {
            let _ = writeln!(text, "{key:<20} = {value}");
            text
        })
    }
}

impl TileWriter<'_> {
    fn write(&self, order: u8, number: usize) -> Result<TileSummary, ProductsError> {
        let (mut previews, mut count) = (Vec::new(), 1);
        let tile = if order == self.order {
            self.sampled(number)
        } else {
            let mut inside = Vec::with_capacity(4);
            for child in 4 * number..4 * number + 4 {
                let written = self.write(order + 1, child)?;
                previews.extend(written.previews);
                count += written.count;
                inside.push(written.tile);
            }
            self.merged(&inside)
        };
        if order == ORDER_MIN {
            let mut small = tile.clone();
            let mut width = self.width;
            while width > PREVIEW_WIDTH {
                small = halved(&small, width);
                width /= 2;
            }
            previews.push((number, small));
        }
        let folder = self.folder.join(format!("Norder{order}/Dir{}", number / 10_000 * 10_000));
        let cards = [
            Card::text("BUNIT", "K", "temperature"),
            Card::integer("ORDER", order.into(), "HEALPix order of the tile"),
            Card::integer("NPIX", number as i64, "NESTED number of the tile"),
        ];
        self.write_both(&folder, &format!("Npix{number}"), self.width, &tile, &cards)?;
        Ok(TileSummary { tile, previews, count })
    }

    /// The values of the map at the pixel centres of a tile.
    fn sampled(&self, number: usize) -> Tile {
        let tiles = 1_usize << self.order;
        let (face, x0, y0) = nested_to_face(tiles, number);
        let side = (tiles * self.width) as f64;
        let coordinate = |first: usize, k: usize| ((first * self.width + k) as f64 + 0.5) / side;
        let mut tile = Vec::with_capacity(self.width * self.width);
        for row in 0..self.width {
            for column in 0..self.width {
                let direction = face_direction(face, coordinate(x0, row), coordinate(y0, column));
                let direction = if self.same_frame { direction } else { rotate(&self.rotation, direction) };
                let value = self.map.values()[pixel_of(self.map.nside(), direction)];
                tile.push(if is_unseen(value) { f32::NAN } else { value as f32 });
            }
        }
        tile
    }

    fn merged(&self, inside: &[Tile]) -> Tile {
        let half = self.width / 2;
        let mut tile = vec![f32::NAN; self.width * self.width];
        for (child, values) in inside.iter().enumerate() {
            // The lower bit of the number is of x, the upper one of y.
            let (down, right) = (child % 2 * half, child / 2 * half);
            for (row, values) in halved(values, self.width).chunks_exact(half).enumerate() {
                let start = (down + row) * self.width + right;
                tile[start..start + half].copy_from_slice(values);
            }
        }
        tile
    }

    /// Writes all tiles of order 3 as one picture.
    fn write_preview(&self, previews: &[(usize, Tile)]) -> Result<(), ProductsError> {
        let width = self.width.min(PREVIEW_WIDTH);
        let columns = PREVIEW_COLUMNS * width;
        let mut all = vec![f32::NAN; columns * width * PREVIEW_TILES.div_ceil(PREVIEW_COLUMNS)];
        for (number, tile) in previews {
            let (down, right) = (number / PREVIEW_COLUMNS * width, number % PREVIEW_COLUMNS * width);
            for (row, values) in tile.chunks_exact(width).enumerate() {
                let start = (down + row) * columns + right;
                all[start..start + width].copy_from_slice(values);
            }
        }
        let cards = [Card::text("BUNIT", "K", "temperature")];
        self.write_both(&self.folder.join(format!("Norder{ORDER_MIN}")), "Allsky", columns, &all, &cards)
    }

    /// Writes an image as FITS and PNG. The thousands of files are not synced one by one, as `properties` marks the export as
    /// complete.
    fn write_both(
        &self,
        folder: &Path,
        name: &str,
        width: usize,
        values: &[f32],
        cards: &[Card],
    ) -> Result<(), ProductsError> {
        let files: [(PathBuf, Vec<u8>); 2] = [
            (folder.join(format!("{name}.fits")), image_bytes(width, values, cards)?),
            (folder.join(format!("{name}.png")), tile_png(&self.scale, width, values)?),
        ];
        let written =
            fs::create_dir_all(folder).map_err(|source| (folder.to_owned(), source)).and_then(|()| {
                files
                    .into_iter()
                    .try_for_each(|(path, bytes)| fs::write(&path, bytes).map_err(|source| (path, source)))
            });
        written.map_err(|(path, source)| ProductsError::Write { path, source })
    }
}

/// Halves the width of a tile by the means of four pixels, without pixels that have no value.
fn halved(values: &[f32], width: usize) -> Tile {
    let half = width / 2;
    let mean = |row: usize, column: usize| {
        let pixels = [0, 1, width, width + 1].map(|step| values[2 * row * width + 2 * column + step]);
        let (sum, count) = pixels
            .iter()
            .filter(|value| !value.is_nan())
            .fold((0.0_f64, 0.0), |(sum, count), &value| (sum + f64::from(value), count + 1.0));
        // NaN if no pixel has a value.
        (sum / count) as f32
    };
    (0..half * half).map(|k| mean(k / half, k % half)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::constants::HEALPIX_UNSEEN;

    #[test]
    fn means_leave_out_pixels_without_value() {
        let nan = f32::NAN;
        let values = [1.0, 2.0, nan, nan, 3.0, 6.0, nan, nan, nan, 5.0, 0.0, 0.0, 7.0, nan, 1.0, 1.0];
        let found = halved(&values, 4);
        assert_eq!((found[0], found[2], found[3]), (3.0, 6.0, 0.5));
        assert!(found[1].is_nan());
    }

    #[test]
    fn a_hips_is_whole_or_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut map = SkyMap::constant(2, Frame::Galactic, 5.0).unwrap();
        map.values_mut()[7] = HEALPIX_UNSEEN;
        let hips = Hips {
            frame: Frame::Galactic,
            scaling: Scaling::Linear,
            title: "two\nlines".into(),
            id: "ivo://UNK.AUTH/P/test".into(),
            date: "2026-01-01T00:00Z".into(),
            frequency_hz: Some(3e6),
        };
        let out = folder.path().join("new");
        let report = hips.write(&map, &out).unwrap();
        assert_eq!((report.order, report.tile_width), (3, 64));
        // Orders 0 to 3.
        assert_eq!(report.tiles, 12 * (1 + 4 + 16 + 64));
        let properties = fs::read_to_string(out.join("properties")).unwrap();
        assert!(properties.contains("obs_title            = two lines\n"), "{properties}");
        // The wavelength at 3 MHz, m.
        assert!(properties.contains("em_min               = 9.993"), "{properties}");
        let again = hips.write(&map, &out).unwrap_err().to_string();
        assert!(again.contains("expected a new or empty folder"), "{again}");
        // An interrupted export has no `properties`, an incomplete tile, and its lock. Other files stay, and so do tiles without the
        // lock.
        let tile = out.join("Norder3/Dir0/Npix5.fits");
        let whole = fs::read(&tile).unwrap();
        fs::remove_file(out.join("properties")).unwrap();
        fs::write(&tile, b"").unwrap();
        let foreign = out.join("notes.txt");
        fs::write(&foreign, b"mine").unwrap();
        assert!(hips.write(&map, &out).is_err() && tile.exists() && foreign.exists());
        fs::remove_file(&foreign).unwrap();
        assert!(hips.write(&map, &out).is_err() && tile.exists());
        fs::write(out.join(UNFINISHED), b"").unwrap();
        hips.write(&map, &out).unwrap();
        assert!(!out.join(UNFINISHED).exists());
        assert_eq!(fs::read(&tile).unwrap(), whole);
        // The tile of order 0 has the standard size.
        let preview = fs::read(out.join("Norder0/Dir0/Npix0.fits")).unwrap();
        assert_eq!(preview.len(), 2880 * (1 + (4 * 64 * 64_usize).div_ceil(2880)));
    }
}
