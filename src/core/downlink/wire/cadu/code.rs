//! Parameters of the Reed-Solomon code (CCSDS 131.0-B, Sect. 4): 255 octets, of which 223 are data.

/// Octets of a codeword.
pub const CODEWORD_BYTES: usize = 255;
/// Octets of parity in a codeword.
pub const PARITY_BYTES: usize = 32;
/// Octets of data in a codeword.
pub const DATA_BYTES: usize = CODEWORD_BYTES - PARITY_BYTES;
/// Maximum number of correctable octets in a codeword.
pub const ERRORS_MAX: usize = PARITY_BYTES / 2;

/// The generator's roots are the powers 11 j of the primitive element, j = 112 to 143.
pub(super) const ROOT_STEP: usize = 11;
pub(super) const ROOT_FIRST: usize = 112;
