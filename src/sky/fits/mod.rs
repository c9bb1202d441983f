//! HEALPix maps in FITS files (FITS Standard 4.0; "HEALPix file format", Hivon 2013), compatible with healpy.
//!
//! A map file needs a small part of FITS: headers of 80-character cards and one binary table of fixed-width columns.
//! Reading uses bounded memory: every size in the header is checked against the length of the file before anything is
//! allocated. Writing produces healpy's cards in healpy's order, and whole files or none. General FITS libraries in
//! Rust trust the header (a forged TFIELDS aborts the process) or need a C library.

mod alm;
mod card;
mod claims;
mod error;
mod frequency;
mod header;
mod image;
mod read;
mod table;
mod write;

pub use alm::write_alm;
pub use card::{Card, CardValue};
pub use error::{FitsError, FitsProblem};
pub use frequency::{
    MapUnderstood, SkyChannel, check_frequencies, check_frequency, read_known_sky, read_prior, read_sky,
    sky_options,
};
pub use header::Header;
pub use image::image_bytes;
pub use read::{
    MapFile, ReadOptions, read_map, read_map_file, read_map_from, read_notes, read_nside, read_whole_map,
    read_whole_map_file,
};
pub use write::{Column, Ordering, Precision, WriteOptions, map_bytes, write_columns, write_map};
