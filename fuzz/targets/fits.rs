//! Sky maps. Headers are written a card a line and padded here, so that the fuzzer need not count to 80 and 2880.
#![no_main]

use std::io::Cursor;

use libfuzzer_sys::fuzz_target;
use lunarray::sky::Frame;
use lunarray::sky::fits::{ReadOptions, read_map_from};

const BLOCK: usize = 2880;
const CARD: usize = 80;

/// Two headers of lines, each up to a byte 0, and data.
fn padded(data: &[u8]) -> Vec<u8> {
    let mut file = Vec::new();
    let mut rest = data;
    for _ in 0..2 {
        let (text, after) = rest.split_at(rest.iter().position(|octet| *octet == 0).unwrap_or(rest.len()));
        rest = after.get(1..).unwrap_or_default();
        for line in text.split(|octet| *octet == b'\n') {
            let mut card = line[..line.len().min(CARD)].to_vec();
            card.resize(CARD, b' ');
            file.extend(card);
        }
        file.extend(b"END");
        file.resize(file.len().next_multiple_of(BLOCK), b' ');
    }
    file.extend(rest);
    file.resize(file.len().next_multiple_of(BLOCK), 0);
    file
}

fuzz_target!(|data: &[u8]| {
    let Some((&how, data)) = data.split_first() else { return };
    let mut file = if how & 1 == 0 { padded(data) } else { data.to_vec() };
    // A partial map of nside 1024 is a hundred megabytes, as documented: more than a fuzzer has time for.
    let mut at = 0;
    while let Some(found) = file[at..].windows(8).position(|word| word == b"NSIDE   ") {
        at += found + 8;
        let digits = file[at..].iter_mut().take(CARD - 8).filter(|octet| octet.is_ascii_digit());
        digits.skip(2).for_each(|octet| *octet = b' ');
    }
    let frame_if_missing = (how & 2 != 0).then_some(Frame::Galactic);
    let frequency_hz = (how & 16 != 0).then_some(10e6);
    let options = ReadOptions { column: (how & 4 == 0).then(|| usize::from(how >> 3 & 3)), frame_if_missing, frequency_hz };
    let length = file.len() as u64;
    match read_map_from(&mut Cursor::new(&file), length, &options) {
        Ok(found) => {
            assert_eq!(found.map.values().len(), 12 * found.map.nside().pow(2));
            let _ = found.map.check_whole();
        }
        Err(problem) => assert!(!problem.to_string().is_empty()),
    }
});
