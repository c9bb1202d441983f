//! Reads bytes at any bit of a stream, and searches for the sync marker.

use multiversion::multiversion;

use super::SYNC_MARKER;

/// Maximum number of wrong bits in a sync marker of either polarity. Noise passes at 2.6e-6 of all bit positions; at a bit
/// error rate of 1 in 400 a true marker fails with a probability of 2e-6.
pub const MARKER_ERRORS_MAX: u32 = 3;

/// The 32 bits from bit `at` on, with zeros beyond the end.
pub(crate) fn word_at(bytes: &[u8], at: usize) -> u32 {
    let mut eight = [0; 8];
    let rest = bytes.get(at / 8..).unwrap_or_default();
    let there = rest.len().min(5);
    eight[..there].copy_from_slice(&rest[..there]);
    (u64::from_be_bytes(eight) << (at % 8) >> 32) as u32
}

/// Copies bytes from bit `at` on. The bits must exist.
pub(crate) fn copy_at(bytes: &[u8], at: usize, out: &mut [u8]) {
    let (first, shift) = (at / 8, at % 8);
    if shift == 0 {
        out.copy_from_slice(&bytes[first..first + out.len()]);
        return;
    }
    let from = &bytes[first..first + out.len() + 1];
    for (octet, pair) in out.iter_mut().zip(from.windows(2)) {
        *octet = pair[0] << shift | pair[1] >> (8 - shift);
    }
}

/// The polarity of a sync marker; `None` if the 32 bits are not a marker.
pub(crate) fn marker_polarity(word: u32) -> Option<Polarity> {
    match (word ^ SYNC_MARKER).count_ones() {
        0..=MARKER_ERRORS_MAX => Some(Polarity::Upright),
        wrong if wrong >= 32 - MARKER_ERRORS_MAX => Some(Polarity::Inverted),
        _ => None,
    }
}

pub(crate) fn marker_errors(word: u32, polarity: Polarity) -> u32 {
    let wrong = (word ^ SYNC_MARKER).count_ones();
    if polarity == Polarity::Upright { wrong } else { 32 - wrong }
}

/// Whether the bits of a stream are as sent or inverted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Polarity {
    #[default]
    Upright,
    Inverted,
}

/// The first bit in `from..to` at which a marker begins. The bytes of a marker at the last bit must exist.
pub(crate) fn find_marker(bytes: &[u8], from: usize, to: usize) -> Option<usize> {
    let mut at = from;
    while at < to {
        // A vectorised search finds the byte; then its bits are searched one by one.
        if at.is_multiple_of(8) {
            at = 8 * find_byte(bytes, at / 8, to / 8);
        }
        let end = to.min(at / 8 * 8 + 8);
        if let Some(found) = (at..end).find(|at| marker_polarity(word_at(bytes, *at)).is_some()) {
            return Some(found);
        }
        at = end;
    }
    None
}

/// The first byte from `from` on in which a marker begins, or `to`, or the first of the last bytes of the buffer, which are
/// too few for the vectorised search.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl+avx512vpopcntdq", "x86_64+avx2+popcnt"))]
fn find_byte(bytes: &[u8], from: usize, to: usize) -> usize {
    const MARKER: u64 = SYNC_MARKER as u64;
    let is_marker = |word: u64, shift: u32| {
        let wrong = ((word >> (32 - shift) & 0xFFFF_FFFF) ^ MARKER).count_ones();
        wrong <= MARKER_ERRORS_MAX || wrong >= 32 - MARKER_ERRORS_MAX
    };
    let end = to.min(bytes.len().saturating_sub(7));
    for (k, window) in bytes[from.min(end)..].windows(8).take(end - from.min(end)).enumerate() {
        let mut eight = [0; 8];
        eight.copy_from_slice(window);
        let word = u64::from_be_bytes(eight);
        let mut any = false;
        for shift in 0..8 {
            any |= is_marker(word, shift);
        }
        if any {
            return from + k;
        }
    }
    end.max(from)
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::units::{StreamKind, random_stream};

    #[test]
    fn a_marker_is_found_at_every_bit() {
        for at in 0..200 {
            for wrong in [0, 1 << 31, 0x8001_0000, 0x0101_0100, !0, !0x0101_0100] {
                let mut bytes = [0x55_u8; 40];
                let word = SYNC_MARKER ^ wrong;
                for bit in 0..32 {
                    let (place, value) = (at + bit, (word >> (31 - bit) & 1) as u8);
                    bytes[place / 8] = bytes[place / 8] & !(0x80 >> (place % 8)) | value << (7 - place % 8);
                }
                assert_eq!(word_at(&bytes, at), word);
                assert_eq!(find_marker(&bytes, 0, 8 * 36), Some(at), "{at}, {wrong:x}");
                assert_eq!(find_marker(&bytes, at, at + 1), Some(at));
                assert_eq!(find_marker(&bytes, 0, at), None);
                assert_eq!(find_marker(&bytes, at + 1, 8 * 36), None);
            }
        }
    }

    #[test]
    fn the_vectorised_search_of_noise_finds_what_a_search_bit_by_bit_finds() {
        let mut noise = vec![0; 1 << 20];
        random_stream(5, StreamKind::Probe, [5, 5]).fill_bytes(&mut noise);
        let to = 8 * (noise.len() - 4);
        let plain: Vec<usize> =
            (0..to).filter(|at| marker_polarity(word_at(&noise, *at)).is_some()).collect();
        let mut found = Vec::new();
        let mut at = 0;
        while let Some(hit) = find_marker(&noise, at, to) {
            found.push(hit);
            at = hit + 1;
        }
        assert_eq!(found, plain);
        assert!(plain.len() > 5, "2 x 5489 / 2^32 of 8e6 places: about 21");
    }

    #[test]
    fn bytes_are_copied_from_any_bit() {
        let bytes = [0b1010_0101, 0b1100_0011, 0b1111_0000, 0];
        let mut out = [0; 2];
        copy_at(&bytes, 3, &mut out);
        assert_eq!(out, [0b0010_1110, 0b0001_1111]);
        copy_at(&bytes, 8, &mut out);
        assert_eq!(out, bytes[1..3]);
    }
}
