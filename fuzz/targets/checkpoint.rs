//! States and engines as they stand on the disk; checksums are put right, so that the fuzzer need not guess them.
#![no_main]

use std::sync::LazyLock;

use crc_fast::CrcAlgorithm::{Crc32Iscsi, Crc64Nvme};
use libfuzzer_sys::fuzz_target;
use lunarray::ground::archive::CoverageSurvey;
use lunarray::imaging::circle::HarmonicEngine;
use lunarray::imaging::{EngineKind, MapConfig, NormalEngine, PixelEngine};

static MAPS: LazyLock<[MapConfig; 2]> = LazyLock::new(|| {
    let of = |engine| MapConfig { engine, ..MapConfig::default() };
    [of(EngineKind::Pixel), of(EngineKind::Harmonic)]
});

/// A state: length of the head, head, engines.
fn state(data: &[u8], map: &MapConfig) {
    let Some((length, body)) = data.split_first_chunk::<2>() else { return };
    let mut file = b"LNRSTA12".to_vec();
    file.extend(u64::from(u16::from_le_bytes(*length)).to_le_bytes());
    file.extend(body);
    file.extend(crc_fast::checksum(Crc64Nvme, &file).to_le_bytes());
    if let Ok(survey) = CoverageSurvey::from_bytes(&file, map) {
        let gaps = survey.gaps();
        for gap in &gaps.gaps {
            assert!(gap.from <= gap.to);
        }
    }
}

/// An engine that is read can be written, and read again.
fn engine<E: NormalEngine>(data: &[u8]) {
    let mut file = data.to_vec();
    file.extend((crc_fast::checksum(Crc32Iscsi, &file) as u32).to_le_bytes());
    if let Ok(mut engine) = E::restore(&mut file.as_slice()) {
        let mut again = Vec::new();
        engine.checkpoint(&mut again).expect("memory takes everything");
        assert!(E::restore(&mut again.as_slice()).is_ok());
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((&how, data)) = data.split_first() else { return };
    match how % 4 {
        2 => engine::<PixelEngine>(data),
        3 => engine::<HarmonicEngine>(data),
        kind => state(data, &MAPS[usize::from(kind)]),
    }
});
