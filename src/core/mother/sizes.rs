//! Sizes on board.

/// Size of one visibility in the store and on the link, bytes.
pub const VISIBILITY_BYTES: u64 = 21;
