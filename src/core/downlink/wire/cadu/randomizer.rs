//! The pseudo-randomizer (CCSDS 131.0-B, section 10): x^8 + x^7 + x^5 + x^3 + 1 from all ones, restarted per block.

use super::reed_solomon::CODEWORD_BYTES;

/// Octets of the longest block, 8 codewords.
const BLOCK_BYTES_MAX: usize = 8 * CODEWORD_BYTES;

/// The sequence that is added to a block, with a period of 255 bits and therefore of 255 octets.
static SEQUENCE: [u8; BLOCK_BYTES_MAX] = sequence();

const fn sequence() -> [u8; BLOCK_BYTES_MAX] {
    let mut out = [0; BLOCK_BYTES_MAX];
    // The uppermost bit is sent next.
    let mut register = 0xFF_u8;
    let mut bit = 0;
    while bit < 8 * BLOCK_BYTES_MAX {
        out[bit / 8] |= (register >> 7) << (7 - bit % 8);
        let next = (register ^ register >> 2 ^ register >> 4 ^ register >> 7) & 1;
        register = register << 1 | next;
        bit += 1;
    }
    out
}

/// Randomizes a block of at most 2040 octets, or derandomizes it.
pub fn randomize(block: &mut [u8]) {
    for (octet, added) in block.iter_mut().zip(&SEQUENCE) {
        *octet ^= added;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sequence_follows_the_standard() {
        // 131.0-B, 10.4.2, gives the first 40 bits.
        assert_eq!(SEQUENCE[..8], [0xFF, 0x48, 0x0E, 0xC0, 0x9A, 0x0D, 0x70, 0xBC]);
        assert!((255..SEQUENCE.len()).all(|k| SEQUENCE[k] == SEQUENCE[k - 255]));
    }
}
