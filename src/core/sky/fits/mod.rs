//! HEALPix maps in FITS files (FITS Standard 4.0; "HEALPix file format", Hivon 2013), compatible with healpy.
//!
//! A map file uses a small part of FITS: headers of 80-character cards and one binary table of fixed-width columns.
//! Reading uses bounded memory: every size in the header is checked against the length of the file before memory is
//! allocated. Writing produces healpy's cards in healpy's order, and is atomic. General FITS libraries in
//! Rust trust the header (a forged TFIELDS aborts the process) or need a C library.

mod alm;
mod card;
mod error;
mod frequency;
mod header;
mod image;
mod keywords;
mod metadata;
mod read;
mod table;
mod write;

#[doc(hidden)]
pub use alm::write_alm;
#[doc(hidden)]
pub use card::{Card, CardValue};
pub use error::FitsError;
#[doc(hidden)]
pub use error::FitsProblem;
#[doc(hidden)]
pub use frequency::{
    MapOutline, SkyChannel, check_frequencies, check_frequency, read_known_sky, read_prior, read_sky,
    sky_notes, sky_options,
};
#[doc(hidden)]
pub use header::Header;
#[doc(hidden)]
pub use image::image_bytes;
#[doc(hidden)]
pub use read::{
    MapFile, read_map_file, read_map_from, read_notes, read_nside, read_whole_map, read_whole_map_file,
};
pub use read::{ReadOptions, read_map};
#[doc(hidden)]
pub use write::{Column, Ordering, Precision, map_bytes, write_columns};
pub use write::{WriteOptions, write_map};
