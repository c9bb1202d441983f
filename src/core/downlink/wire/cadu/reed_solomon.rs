//! The Reed-Solomon code (255, 223) with interleaving and the dual basis (CCSDS 131.0-B, section 4).
//!
//! The octets of a block belong to its codewords in turn. A codeword has 223 octets of data and 32 of parity, which are the
//! remainder of the data times x^32 divided by g(x) = prod (x - a^(11 j)), j = 112..=143. Up to 16 wrong octets of a
//! codeword are corrected.
//!
//! The remainder is linear in the data, also in the dual basis, so it is computed from tables, four octets at a time
//! (as in sliced CRCs). A received codeword has no errors if the remainder of its data equals its parity. Otherwise the
//! syndromes follow from the difference of the two.

use std::sync::LazyLock;

use multiversion::multiversion;

pub use super::code::{CODEWORD_BYTES, DATA_BYTES, ERRORS_MAX, PARITY_BYTES};
use super::code::{ROOT_FIRST, ROOT_STEP};
use super::field::{FIELD, ORDER};
use super::locator::{Errors, locate};
pub use crate::downlink::config::INTERLEAVES;

/// Octets processed per table lookup.
const SLICE: usize = 4;
/// Number of slices of a codeword's data; the first slice has one octet less.
const SLICES: usize = DATA_BYTES.div_ceil(SLICE);

/// Parity of a codeword: 32 octets, the first one sent in the upper bits of the first word.
type Parity = [u32; PARITY_BYTES / 4];

/// Syndromes indexed by place, half octet and value.
type SyndromeTables = [[[[u8; PARITY_BYTES]; 16]; 2]; PARITY_BYTES];

/// The error of a codeword with more wrong octets than can be corrected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Uncorrectable;

/// Remainders (dual basis) of an octet, by its place in a slice and its value.
static REMAINDERS: LazyLock<Box<[[Parity; 256]; SLICE]>> = LazyLock::new(remainder_tables);

/// Syndromes (conventional basis) of half an octet of a difference (dual basis), by place, half (upper first) and value.
static SYNDROMES: LazyLock<Box<SyndromeTables>> = LazyLock::new(syndrome_tables);

/// The code at a depth of interleaving.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReedSolomon {
    interleave: usize,
}

impl ReedSolomon {
    /// The code at a depth of interleaving; `None` if it is not one of [`INTERLEAVES`].
    #[must_use]
    pub fn new(interleave: usize) -> Option<Self> {
        INTERLEAVES.contains(&interleave).then_some(Self { interleave })
    }

    /// Depth of interleaving.
    #[must_use]
    pub fn interleave(self) -> usize {
        self.interleave
    }

    /// Octets of data in a block.
    #[must_use]
    pub fn data_bytes(self) -> usize {
        DATA_BYTES * self.interleave
    }

    /// Octets of a block.
    #[must_use]
    pub fn block_bytes(self) -> usize {
        CODEWORD_BYTES * self.interleave
    }

    /// Computes the parity of a block of [`ReedSolomon::block_bytes`] octets, whose data are filled in.
    pub fn encode(self, block: &mut [u8]) {
        let found = self.remainders(block);
        for (at, row) in block[self.data_bytes()..].chunks_exact_mut(self.interleave).enumerate() {
            for (octet, parity) in row.iter_mut().zip(&found) {
                *octet = octet_of(parity, at);
            }
        }
    }

    /// Corrects a block of [`ReedSolomon::block_bytes`] octets; returns the number of octets corrected.
    ///
    /// # Errors
    /// A codeword has more errors than can be corrected; the block may then be partly corrected.
    pub fn decode(self, block: &mut [u8]) -> Result<usize, Uncorrectable> {
        let mut found = self.remainders(block);
        let mut wrong = 0;
        for (at, row) in block[self.data_bytes()..].chunks_exact(self.interleave).enumerate() {
            for (octet, parity) in row.iter().zip(&mut found) {
                parity[at / 4] ^= u32::from(*octet) << (24 - 8 * (at % 4));
            }
        }
        for (codeword, difference) in found.iter().enumerate().take(self.interleave) {
            if *difference == Parity::default() {
                continue;
            }
            let Errors { count, places, values } = locate(&syndromes(difference)).ok_or(Uncorrectable)?;
            wrong += count;
            for (place, value) in places.iter().zip(values).take(count) {
                let at = usize::from(*place) * self.interleave + codeword;
                block[at] ^= FIELD.to_dual[usize::from(value)];
            }
        }
        Ok(wrong)
    }

    fn remainders(self, block: &[u8]) -> [Parity; 8] {
        let mut found = [Parity::default(); 8];
        let data = &block[..self.data_bytes()];
        // A depth known at compile time keeps all codewords in registers.
        match self.interleave {
            1 => divide::<1>(data, &REMAINDERS, &mut found),
            2 => divide::<2>(data, &REMAINDERS, &mut found),
            3 => divide::<3>(data, &REMAINDERS, &mut found),
            4 => divide::<4>(data, &REMAINDERS, &mut found),
            5 => divide::<5>(data, &REMAINDERS, &mut found),
            _ => divide::<8>(data, &REMAINDERS, &mut found),
        }
        found
    }
}

fn octet_of(parity: &Parity, at: usize) -> u8 {
    (parity[at / 4] >> (24 - 8 * (at % 4))) as u8
}

#[multiversion(targets("x86_64+avx2"))]
fn divide<const I: usize>(data: &[u8], tables: &[[Parity; 256]; SLICE], out: &mut [Parity; 8]) {
    let mut registers = [Parity::default(); I];
    let (first, rest) = data.split_at((DATA_BYTES - SLICE * (SLICES - 1)) * I);
    for (c, register) in registers.iter_mut().enumerate() {
        let word = u32::from(first[c]) << 16 | u32::from(first[I + c]) << 8 | u32::from(first[2 * I + c]);
        *register = advance(register, word, tables);
    }
    for slice in rest.chunks_exact(SLICE * I) {
        for (c, register) in registers.iter_mut().enumerate() {
            let word = u32::from_be_bytes([slice[c], slice[I + c], slice[2 * I + c], slice[3 * I + c]]);
            *register = advance(register, word, tables);
        }
    }
    out[..I].copy_from_slice(&registers);
}

/// Advances a remainder by four octets of data.
#[inline(always)]
fn advance(register: &Parity, word: u32, tables: &[[Parity; 256]; SLICE]) -> Parity {
    let feedback = (register[0] ^ word).to_be_bytes();
    let [a, b, c, d] = [0, 1, 2, 3].map(|k| &tables[k][usize::from(feedback[k])]);
    let mut next = [0; PARITY_BYTES / 4];
    for k in 0..PARITY_BYTES / 4 {
        let shifted = if k + 1 < PARITY_BYTES / 4 { register[k + 1] } else { 0 };
        next[k] = shifted ^ a[k] ^ b[k] ^ c[k] ^ d[k];
    }
    next
}

/// Syndromes S_j, j = 112..=143, of a difference between parities.
fn syndromes(difference: &Parity) -> [u8; PARITY_BYTES] {
    let tables = &*SYNDROMES;
    let mut sum = [0; PARITY_BYTES];
    for (at, [upper, lower]) in tables.iter().enumerate() {
        let octet = octet_of(difference, at);
        let (a, b) = (&upper[usize::from(octet >> 4)], &lower[usize::from(octet & 15)]);
        for k in 0..PARITY_BYTES {
            sum[k] ^= a[k] ^ b[k];
        }
    }
    sum
}

/// Coefficients of the generator without its leading one, the highest first.
fn generator() -> [u8; PARITY_BYTES] {
    let mut g = [0_u8; PARITY_BYTES + 1];
    // Coefficients by rising powers.
    g[0] = 1;
    for j in 0..PARITY_BYTES {
        let root = FIELD.power(ROOT_STEP * (ROOT_FIRST + j));
        for k in (0..=j + 1).rev() {
            let lower = if k > 0 { g[k - 1] } else { 0 };
            g[k] = lower ^ FIELD.multiply(g[k], root);
        }
    }
    std::array::from_fn(|k| g[PARITY_BYTES - 1 - k])
}

fn remainder_tables() -> Box<[[Parity; 256]; SLICE]> {
    let generator = generator();
    let mut tables = Box::new([[Parity::default(); 256]; SLICE]);
    // x^32 mod g for the last octet of a slice, x^33 mod g for the one before, and so on.
    let mut remainder = generator;
    for table in tables.iter_mut().rev() {
        for (value, row) in table.iter_mut().enumerate() {
            let symbol = FIELD.to_conventional[value];
            for (at, coefficient) in remainder.iter().enumerate() {
                let octet = FIELD.to_dual[usize::from(FIELD.multiply(symbol, *coefficient))];
                row[at / 4] |= u32::from(octet) << (24 - 8 * (at % 4));
            }
        }
        let lead = remainder[0];
        remainder.rotate_left(1);
        remainder[PARITY_BYTES - 1] = 0;
        for (coefficient, g) in remainder.iter_mut().zip(generator) {
            *coefficient ^= FIELD.multiply(lead, g);
        }
    }
    tables
}

fn syndrome_tables() -> Box<SyndromeTables> {
    let mut tables = Box::new([[[[0; PARITY_BYTES]; 16]; 2]; PARITY_BYTES]);
    for (at, halves) in tables.iter_mut().enumerate() {
        let power = PARITY_BYTES - 1 - at;
        for (half, rows) in halves.iter_mut().enumerate() {
            for (value, row) in rows.iter_mut().enumerate() {
                let symbol = FIELD.to_conventional[value << (4 - 4 * half)];
                for (j, syndrome) in row.iter_mut().enumerate() {
                    let root = ROOT_STEP * (ROOT_FIRST + j) % ORDER;
                    *syndrome = FIELD.multiply(symbol, FIELD.power(root * power));
                }
            }
        }
    }
    tables
}

#[cfg(test)]
mod tests {
    use rand::{Rng, RngExt};

    use super::*;
    use crate::units::{StreamKind, random_stream};

    /// Parity by libfec 1.0 (Debian, encode_rs_ccsds) of two data blocks, with octet i equal to i and to 7 i^2 + 13.
    const LIBFEC: [[u8; PARITY_BYTES]; 2] = [
        [
            0x4F, 0xFB, 0x92, 0xDD, 0x55, 0x7E, 0xC6, 0x7F, 0x27, 0xFB, 0x89, 0x82, 0xCF, 0x58, 0xF8, 0xFD,
            0x02, 0x8A, 0xD1, 0x17, 0xFC, 0xEF, 0x6B, 0x27, 0x93, 0xD0, 0x41, 0x88, 0x26, 0x57, 0x86, 0x51,
        ],
        [
            0xF6, 0xFA, 0xAD, 0x48, 0x7B, 0x71, 0xB6, 0x3F, 0x6F, 0x00, 0x9F, 0x11, 0xD1, 0x1F, 0x30, 0x3E,
            0xBB, 0x29, 0xEB, 0x59, 0x3A, 0x4C, 0xD9, 0x59, 0xBB, 0x81, 0x66, 0xB0, 0x22, 0xA9, 0xCB, 0x33,
        ],
    ];

    fn random_block(code: ReedSolomon, seed: u64) -> Vec<u8> {
        let mut block = vec![0; code.block_bytes()];
        random_stream(seed, StreamKind::Probe, [0, 0]).fill_bytes(&mut block);
        code.encode(&mut block);
        block
    }

    #[test]
    fn parity_equals_libfec() {
        let code = ReedSolomon::new(1).unwrap();
        let data: [fn(usize) -> usize; 2] = [|i| i, |i| 7 * i * i + 13];
        for (octet, parity) in data.into_iter().zip(LIBFEC) {
            let mut block: Vec<u8> = (0..CODEWORD_BYTES).map(|i| octet(i) as u8).collect();
            code.encode(&mut block);
            assert_eq!(block[DATA_BYTES..], parity);
        }
    }

    #[test]
    fn the_generator_is_symmetric() {
        // 131.0-B, 4.3.3: the coefficients are symmetric. In libfec they begin with a^0, a^249, a^59, a^66.
        let g = generator();
        for (at, power) in [(0, 249), (1, 59), (2, 66), (30, 249), (31, 0)] {
            assert_eq!(g[at], FIELD.power(power), "{at}");
        }
        assert!((0..31).all(|k| g[k] == g[30 - k]));
    }

    #[test]
    fn interleaved_codewords_are_codewords_of_depth_one() {
        let single = ReedSolomon::new(1).unwrap();
        for depth in INTERLEAVES {
            let block = random_block(ReedSolomon::new(depth).unwrap(), depth as u64);
            for codeword in 0..depth {
                let sent: Vec<u8> = block.iter().skip(codeword).step_by(depth).copied().collect();
                let mut encoded = sent.clone();
                encoded[DATA_BYTES..].fill(0);
                single.encode(&mut encoded);
                assert_eq!(encoded, sent);
            }
        }
    }

    #[test]
    fn sixteen_errors_of_each_codeword_are_corrected() {
        let mut random = random_stream(1, StreamKind::Probe, [1, 0]);
        for trial in 0..400 {
            let depth = INTERLEAVES[trial % INTERLEAVES.len()];
            let code = ReedSolomon::new(depth).unwrap();
            let sent = random_block(code, trial as u64);
            let mut block = sent.clone();
            let mut wrong = 0;
            for codeword in 0..depth {
                let count = if trial < 12 { ERRORS_MAX } else { random.random_range(0..=ERRORS_MAX) };
                let places = rand::seq::index::sample(&mut random, CODEWORD_BYTES, count);
                wrong += count;
                for place in places {
                    block[place * depth + codeword] ^= random.random_range(1..=255_u8);
                }
            }
            assert_eq!(code.decode(&mut block), Ok(wrong));
            assert!(block == sent);
        }
    }

    #[test]
    fn more_than_sixteen_errors_are_refused_and_never_miscorrected() {
        let mut random = random_stream(2, StreamKind::Probe, [2, 0]);
        let code = ReedSolomon::new(1).unwrap();
        for trial in 0..2_000 {
            let mut block = random_block(code, trial);
            let count = 17 + trial as usize % 20;
            for place in rand::seq::index::sample(&mut random, CODEWORD_BYTES, count) {
                block[place] ^= random.random_range(1..=255_u8);
            }
            // A wrong correction has a probability below 1/16! = 5e-14.
            assert_eq!(code.decode(&mut block), Err(Uncorrectable), "{count}");
        }
    }

    #[test]
    fn depths_outside_the_standard_are_refused() {
        assert!([0, 6, 7, 9, 255].into_iter().all(|depth| ReedSolomon::new(depth).is_none()));
    }
}
