//! Colours of lines, text and background.

/// Red, green, blue, 0-255.
pub(super) type Colour = [u8; 3];

pub(super) const WHITE: Colour = [255, 255, 255];
pub(super) const INK: Colour = [38, 38, 43];
pub(super) const FAINT: Colour = [120, 120, 128];
