//! Transfer frames on a coded link: the layer between packets and bits.
//!
//! | layer | standard | here |
//! |---|---|---|
//! | AOS transfer frame, packet zone | CCSDS 732.0-B | [`FrameHeader`], `framer`, `receive::cadu::assembler` |
//! | Reed-Solomon (255, 223), dual basis, interleaved | 131.0-B, 4 | [`ReedSolomon`] |
//! | pseudo-randomizer | 131.0-B, 10 | [`randomize`] |
//! | attached sync marker | 131.0-B, 9 | [`SYNC_MARKER`], [`crate::downlink::receive::cadu::CaduReceiver`] |
//!
//! A channel access data unit (CADU) is the marker and a randomized block of 255 I octets: 223 I of the frame,
//! 32 I of parity. By default I = 5, hence 1279 octets. A frame is
//!
//! | octets | field | |
//! |---|---|---|
//! | 0-1 | version 01, spacecraft (8 bits), virtual channel (6) | |
//! | 2-4 | frame count of the virtual channel | low 24 bits |
//! | 5 | replay 0, count usage 1, spare 00, count cycle | the cycle extends the count to 28 bits |
//! | 6-7 | spare (5 bits), first header pointer (11) | 0x7FF: no packet begins here; 0x7FE: idle data only |
//! | 8.. | packets, one running into the next frame | |
//!
//! Managed parameters: no frame header error control, no insert zone, no operational control field, and no frame
//! error control field (CRC), which 732.0-B omits where Reed-Solomon decoding detects bad frames: a wrong correction has a
//! probability of 5e-14, and packets have checksums.
//!
//! Virtual channels: [`SCIENCE`] (instrument, ephemeris, visibilities), [`HOUSEKEEPING`], [`IDLE`] (frames of idle data
//! at the start of each pass, for the ground to synchronise). A pass ends with its housekeeping packet. An idle packet
//! fills the rest of the frame, so that a lost pass does not damage its neighbours.

pub(crate) mod bits;
mod code;
mod encoder;
mod field;
pub(crate) mod frame;
pub(crate) mod framer;
mod locator;
mod randomizer;
mod reed_solomon;

pub use bits::MARKER_ERRORS_MAX;
pub use encoder::CaduEncoder;
pub use frame::{FRAME_HEADER_BYTES, FrameHeader, HOUSEKEEPING, IDLE, SCIENCE};
pub use randomizer::randomize;
pub use reed_solomon::{
    CODEWORD_BYTES, DATA_BYTES, ERRORS_MAX, INTERLEAVES, PARITY_BYTES, ReedSolomon, Uncorrectable,
};

/// The attached sync marker, neither coded nor randomized (131.0-B, 9.3).
pub const SYNC_MARKER: u32 = 0x1ACF_FC1D;

/// Octets of the marker.
pub const SYNC_MARKER_BYTES: usize = 4;
