//! Map files: round trips, error messages, and hostile files.

mod headers;

use std::fs;
use std::io::Cursor;
use std::path::Path;

use lunarray::sky::fits::{
    Card, CardValue, Column, FitsError, FitsProblem, MapFile, MapOutline, Ordering, Precision, ReadOptions,
    SkyChannel, WriteOptions, check_frequency, image_bytes, read_known_sky, read_map, read_map_file,
    read_map_from, read_notes, read_prior, read_sky, read_whole_map, sky_notes, write_alm, write_columns,
    write_map,
};
use lunarray::sky::harmonics::AnalysisOptions;
use lunarray::sky::{Frame, MapError, MapFrequency, SkyConfig, SkyMap};
use lunarray::units::constants::HEALPIX_UNSEEN;
use proptest::prelude::*;

/// Values that are exact in single precision.
fn map(nside: usize) -> SkyMap {
    SkyMap::new(Frame::Galactic, (0..12 * nside * nside).map(|p| 0.5 + p as f64).collect()).unwrap()
}

fn bytes_of(map: &SkyMap, options: &WriteOptions) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.fits");
    write_map(&path, map, options).unwrap();
    fs::read(path).unwrap()
}

fn parse(bytes: &[u8]) -> Result<MapFile, FitsProblem> {
    read_map_from(&mut Cursor::new(bytes), bytes.len() as u64, &ReadOptions::default())
}

fn all_options() -> Vec<WriteOptions> {
    let mut all = Vec::new();
    for precision in [Precision::Single, Precision::Double] {
        for ordering in [Ordering::Ring, Ordering::Nested] {
            for partial in [false, true] {
                all.push(WriteOptions { precision, ordering, partial, cards: vec![] });
            }
        }
    }
    all
}

/// The bytes with the card of a keyword replaced.
fn forged(bytes: &[u8], card: &str) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    let card = format!("{card:<80}");
    let key = &card.as_bytes()[..8];
    let at = bytes.as_chunks::<80>().0.iter().rposition(|c| c.starts_with(key)).unwrap() * 80;
    bytes[at..at + 80].copy_from_slice(card.as_bytes());
    bytes
}

#[test]
fn maps_come_back_as_they_were_written() {
    for nside in [1, 2, 8, 16, 64] {
        for options in all_options() {
            let map = map(nside);
            let bytes = bytes_of(&map, &options);
            assert_eq!(bytes.len() % 2880, 0);
            let file = parse(&bytes).unwrap();
            assert_eq!(file.map, map, "{nside} {options:?}");
            assert_eq!((file.name.as_str(), file.unit.as_str()), ("TEMPERATURE", "K"));
            assert!(!file.frame_assumed);
        }
    }
}

#[test]
fn unseen_pixels_stay_unseen() {
    let mut map = map(64);
    for pixel in [0, 77, 40_000] {
        map.values_mut()[pixel] = HEALPIX_UNSEEN;
    }
    for options in all_options() {
        let read = parse(&bytes_of(&map, &options)).unwrap().map;
        assert_eq!(read, map, "{options:?}");
        let expected = MapError::BadPixels { count: 3, total: 49_152, first: 0, value: HEALPIX_UNSEEN };
        assert_eq!(read.check_whole(), Err(expected));
    }
}

#[test]
fn several_columns_and_provenance_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("maps.fits");
    let (one, two) = (map(16), SkyMap::constant(16, Frame::Galactic, 0.25).unwrap());
    let hash = "0123456789abcdef".repeat(7);
    let cards = vec![
        Card::text("CFGHASH", &hash, "cut if long"),
        Card::integer("SEED", 17, "seed"),
        Card::real("FREQ", 1e7, "Hz"),
    ];
    let options = WriteOptions { cards: cards.clone(), ..WriteOptions::default() };
    let columns = [
        Column { name: "TEMPERATURE", unit: "K", values: one.values() },
        Column { name: "NOISE", unit: "", values: two.values() },
    ];
    write_columns(&path, Frame::Galactic, &columns, &options).unwrap();
    let second = read_map_file(&path, &ReadOptions { column: Some(1), ..ReadOptions::default() }).unwrap();
    assert_eq!((second.map, second.name.as_str(), second.unit.as_str()), (two, "NOISE", ""));
    assert_eq!(second.header.get("CFGHASH"), Some(&CardValue::Text(hash)));
    // Those of the file's first header follow.
    assert!(second.header.cards().windows(cards.len()).any(|some| some == cards));
    let third = read_map(&path, &ReadOptions { column: Some(2), ..ReadOptions::default() });
    assert!(matches!(*third.unwrap_err().problem, FitsProblem::NoColumn { column: 2, columns: 2 }));
}

#[test]
fn every_file_names_its_program_once_and_no_date() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("alm.fits");
    let sky = map(4);
    write_alm(&path, &sky.harmonics(3, &AnalysisOptions::default()).unwrap(), &[]).unwrap();
    let cards = |name: &str| WriteOptions {
        cards: vec![Card::text("CREATOR", name, "another program")],
        ..WriteOptions::default()
    };
    let own = concat!("CREATOR = 'lunarray ", env!("CARGO_PKG_VERSION"), "'");
    for (bytes, expected) in [
        (bytes_of(&sky, &WriteOptions::default()), own),
        (fs::read(&path).unwrap(), own),
        (image_bytes(2, &[1.0, 2.0], &[]).unwrap(), own),
        (bytes_of(&sky, &cards("other")), "CREATOR = 'other   '"),
    ] {
        let with = |key: &str| -> Vec<String> {
            let cards = bytes.as_chunks::<80>().0.iter().filter(|card| card.starts_with(key.as_bytes()));
            cards.map(|card| String::from_utf8_lossy(card).into_owned()).collect()
        };
        let found = with("CREATOR ");
        assert!(found.len() == 1 && found[0].starts_with(expected), "{found:?}");
        // The time of writing would change the bytes of equal maps.
        assert_eq!(with("DATE "), Vec::<String>::new());
    }
}

#[test]
fn a_failed_write_leaves_the_old_file_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.fits");
    write_map(&path, &map(4), &WriteOptions::default()).unwrap();
    let before = fs::read(&path).unwrap();
    let bad = WriteOptions { cards: vec![Card::text("lower", "", "")], ..WriteOptions::default() };
    assert!(write_map(&path, &map(2), &bad).is_err());
    let huge = SkyMap::constant(2, Frame::Ecliptic, 1e300).unwrap();
    let error = write_map(&path, &huge, &WriteOptions::default()).unwrap_err();
    assert!(matches!(*error.problem, FitsProblem::Overflow { pixel: 0, .. }));
    assert!(write_map(&path.join("such.fits"), &map(2), &WriteOptions::default()).is_err());
    // A folder cannot be replaced by a file.
    let taken = folder.path().join("folder");
    fs::create_dir(&taken).unwrap();
    assert!(write_map(&taken, &map(2), &WriteOptions::default()).is_err());
    assert_eq!(fs::read(&path).unwrap(), before);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
}

#[test]
fn messages_name_file_finding_and_expectation() {
    let folder = tempfile::tempdir().unwrap();
    let good = bytes_of(&map(16), &WriteOptions::default());
    let message = |bytes: &[u8]| {
        let path = folder.path().join("sky.fits");
        fs::write(&path, bytes).unwrap();
        let text = read_whole_map(&path, &ReadOptions::default()).unwrap_err().to_string();
        assert!(text.contains("sky.fits"), "{text}");
        text
    };
    assert!(message(b"").contains("empty"));
    assert!(message(b"%PDF-1.4 etc").contains("a PDF file"));
    assert!(message(&[0x1f, 0x8b, 8, 0]).contains("gzip"));
    assert!(message(&good[..2880]).contains("BINTABLE"));
    assert!(message(&good[..4000]).contains("truncated"));
    assert!(message(&good[..10_000]).contains("truncated"));
    assert!(message(&forged(&good, "NSIDE   = 17")).contains("NSIDE is 17"));
    assert!(message(&forged(&good, "NSIDE   = 32")).contains("12288"));
    assert!(message(&forged(&good, "ORDERING= 'SPIRAL'")).contains("SPIRAL"));
    assert!(message(&forged(&good, "ORDERING= T")).contains("ORDERING is T; expected RING or NESTED"));
    assert!(message(&forged(&good, "COORDSYS= 'X'")).contains("'X'"));
    assert!(message(&forged(&good, "COORDSYS")).contains("COORDSYS is missing"));
    assert!(message(&forged(&good, "NAXIS2")).contains("NAXIS2 is missing"));
    let mut nan = map(16);
    nan.values_mut()[5] = f64::NAN;
    assert!(message(&bytes_of(&nan, &WriteOptions::default())).contains("pixel 5"));
    let missing: FitsError =
        read_map(&folder.path().join("absent.fits"), &ReadOptions::default()).unwrap_err();
    assert!(missing.to_string().contains("absent.fits") && std::error::Error::source(&missing).is_some());
}

#[test]
fn a_file_without_a_frame_needs_one_named() {
    let bytes = forged(&bytes_of(&map(16), &WriteOptions::default()), "COORDSYS");
    assert!(matches!(parse(&bytes), Err(FitsProblem::NoFrame)));
    let options = ReadOptions { frame_if_missing: Some(Frame::Equatorial), ..ReadOptions::default() };
    let file = read_map_from(&mut Cursor::new(&bytes), bytes.len() as u64, &options).unwrap();
    assert_eq!((file.map.frame(), file.frame_assumed), (Frame::Equatorial, true));
}

#[test]
fn forged_sizes_neither_panic_nor_allocate() {
    let whole = bytes_of(&map(16), &WriteOptions::default());
    let partial = bytes_of(&map(16), &WriteOptions { partial: true, ..WriteOptions::default() });
    // Any of these, if trusted, would allocate terabytes and abort.
    let huge = ["1000000000000000", "9223372036854775807", "-1", "99999999999999999999999", "1E300", "'x'"];
    let keys = ["NAXIS1", "NAXIS2", "TFIELDS", "NSIDE", "PCOUNT", "GCOUNT"];
    for bytes in [&whole, &partial] {
        for key in keys {
            for value in huge {
                let result = parse(&forged(bytes, &format!("{key:<8}= {value}")));
                // Nothing of a fixed-width table depends on these two.
                assert!(result.is_err() || key == "PCOUNT" || key == "GCOUNT", "{key} = {value}");
            }
        }
        for form in ["1000000000000E", "99999999999999999999E", "0E", "PE(5)", "7", "", "1Z", "4X"] {
            for column in 1..=2 {
                let card = format!("TFORM{column}  = '{form}'");
                if bytes.as_chunks::<80>().0.iter().any(|c| c.starts_with(&card.as_bytes()[..9])) {
                    assert!(parse(&forged(bytes, &card)).is_err(), "{card}");
                }
            }
        }
    }
    let sparse = parse(&forged(&partial, "NSIDE   = 8192"));
    assert!(matches!(sparse, Err(FitsProblem::Sparse { nside: 8192, .. })));
}

#[test]
fn pixels_given_twice_or_out_of_range_are_refused() {
    let partial = bytes_of(&map(4), &WriteOptions { partial: true, ..WriteOptions::default() });
    let rows = partial.len() - 2880;
    for number in [[0, 1], [0xff, 0xff], [0, 192]] {
        let mut bytes = partial.clone();
        bytes[rows..rows + 2].copy_from_slice(&number);
        // Pixel 1 given first makes its own row, the second, the repetition.
        assert!(matches!(parse(&bytes), Err(FitsProblem::Pixel { .. })), "{number:?}");
    }
}

proptest! {
    #[test]
    fn truncation_is_an_error(cut in 0.0..1.0_f64, form in 0_usize..8) {
        let bytes = bytes_of(&map(16), &all_options()[form]);
        // The padding of the last block may be missing.
        let data_end = bytes.len() - 2880;
        prop_assert!(parse(&bytes[..(cut * data_end as f64) as usize]).is_err());
    }

    #[test]
    fn flipped_bits_do_not_panic(flips in prop::collection::vec((0.0..1.0_f64, 0_u8..8), 1..20), form in 0_usize..8) {
        let mut bytes = bytes_of(&map(2), &all_options()[form]);
        // Mostly in the headers, where they matter.
        for (place, bit) in flips {
            let at = (place * bytes.len() as f64) as usize;
            bytes[at] ^= 1 << bit;
        }
        if let Ok(file) = parse(&bytes) {
            prop_assert!(file.map.values().len() == 12 * file.map.nside().pow(2));
        }
    }

    #[test]
    fn arbitrary_bytes_do_not_panic(tail in prop::collection::vec(any::<u8>(), 0..6000)) {
        let mut bytes = b"SIMPLE  =                    T".to_vec();
        bytes.extend(tail);
        prop_assert!(parse(&bytes).is_err());
    }
}

#[test]
fn temperatures_come_in_kelvin_whatever_their_unit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.fits");
    let map = map(2);
    let bytes = bytes_of(&map, &WriteOptions { precision: Precision::Double, ..WriteOptions::default() });
    let read = |unit: &str| {
        fs::write(&path, forged(&bytes, &format!("TUNIT1  = '{unit}'"))).unwrap();
        read_whole_map(&path, &ReadOptions::default())
    };
    for (unit, factor) in
        [("K", 1.0), ("", 1.0), ("K_RJ", 1.0), ("Kelvin", 1.0), ("mK", 1e-3), ("uK_CMB", 1e-6), ("MK", 1e6)]
    {
        let found = read(unit).unwrap();
        for (found, value) in found.values().iter().zip(map.values()) {
            assert_eq!(*found, factor * value, "{unit}");
        }
    }
    assert!(fs::read(&path).is_ok() && read_map_file(&path, &ReadOptions::default()).unwrap().unit == "MK");
    fs::write(&path, forged(&bytes, "TUNIT1  =                   17")).unwrap();
    let refused = read_whole_map(&path, &ReadOptions::default()).unwrap_err().to_string();
    assert!(refused.contains("TUNIT1 is 17"), "{refused}");
    // What its frequency would convert is refused without one.
    assert!(read("MJy/sr").unwrap_err().to_string().contains("FREQ is missing"));
    for unit in ["K km/s", "Jy/beam", "counts", "mJy"] {
        let refused = read(unit).unwrap_err().to_string();
        assert!(refused.contains(&format!("`{unit}`")) && refused.contains("expected K"), "{refused}");
    }
}

#[test]
fn pixels_of_another_scheme_are_refused() {
    let bytes = bytes_of(&map(2), &WriteOptions::default());
    for (value, good) in [("'HEALPIX'", true), ("'healpix '", true), ("'WCS'", false), ("T", false)] {
        let parsed = parse(&forged(&bytes, &format!("PIXTYPE = {value}")));
        match parsed {
            Ok(_) => assert!(good, "{value}"),
            Err(problem) => {
                let text = problem.to_string();
                assert!(!good && text.contains("PIXTYPE") && text.contains("'HEALPIX'"), "{text}");
            }
        }
    }
}

/// The map of a sky by a rule for its frequency.
fn read_for(
    path: &Path,
    frequency_hz: f64,
    frequency: MapFrequency,
    is_dark_accepted: bool,
) -> Result<SkyMap, FitsError> {
    let channel = SkyChannel { frequency_hz, is_dark_accepted, is_file_shared: false };
    read_sky(path, &channel, &SkyConfig { frequency, ..SkyConfig::default() })
}

#[test]
fn a_sky_that_is_none_is_refused_with_file_pixel_and_value() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sky.fits");
    let read = |value: f64, is_dark_accepted: bool| {
        let mut values = vec![0.0; 48];
        (values[7], values[9]) = (value, 0.5 * value);
        let map = SkyMap::new(Frame::Ecliptic, values).unwrap();
        let options = WriteOptions { precision: Precision::Double, ..WriteOptions::default() };
        write_map(&path, &map, &options).unwrap();
        read_for(&path, 3e6, MapFrequency::MustMatch, is_dark_accepted).map_err(|error| error.to_string())
    };
    assert!(read(1e7, false).is_ok() && read(0.0, true).is_ok());
    // -1.5 K in 48 pixels.
    let refusals = [
        (-1.0, "the mean of the pixels is -3.125e-2 K"),
        (-1e17, "pixel 7 with -1e17 K"),
        (1e307, "pixel 7 with 1e307 K"),
        (0.0, "the mean of the pixels is 0e0 K"),
        (1e-199, "the mean of the pixels is 3.1"),
    ];
    for (value, words) in refusals {
        let refused = read(value, false).unwrap_err();
        assert!(refused.contains("sky.fits") && refused.contains(words), "{refused}");
    }
}

#[test]
fn a_sky_of_another_frequency_is_refused_or_scaled() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, cards: Vec<Card>| {
        let path = folder.path().join(name);
        write_map(&path, &map(4), &WriteOptions { cards, ..WriteOptions::default() }).unwrap();
        path
    };
    let at_3 = write("3.fits", vec![Card::real("FREQ", 3e6, "Hz")]);
    let unknown = write("unknown.fits", Vec::new());
    let worded = write("worded.fits", vec![Card::text("FREQ", "about 3 MHz", "")]);
    let scaled = MapFrequency::SpectralIndex(-2.5);

    let said = read_for(&at_3, 10e6, MapFrequency::MustMatch, true).unwrap_err().to_string();
    for part in ["3.fits", "FREQ is 3 MHz", "10 MHz", "sky.frequency = { spectral_index"] {
        assert!(said.contains(part), "{said}");
    }
    assert_eq!(read_for(&at_3, 3e6, MapFrequency::MustMatch, true).unwrap(), map(4));
    assert_eq!(read_for(&at_3, 3e6, scaled, true).unwrap(), map(4));
    // (10 / 3)^-2.5 = 0.3^2 sqrt(0.3).
    let factor = 0.09 * 0.547_722_557_505;
    let found = read_for(&at_3, 10e6, scaled, true).unwrap();
    for (found, value) in found.values().iter().zip(map(4).values()) {
        assert!((found / value / factor - 1.0).abs() < 1e-11, "{found} {value}");
    }
    // A map that does not say its frequency may be of any, but of one channel, and cannot be scaled.
    let shared = SkyChannel { frequency_hz: 10e6, is_dark_accepted: true, is_file_shared: true };
    let said = read_sky(&unknown, &shared, &SkyConfig::default()).unwrap_err().to_string();
    assert!(said.contains("FREQ is missing") && said.contains("one map per channel"), "{said}");
    let at_own = SkyChannel { frequency_hz: 3e6, ..shared };
    assert!(read_sky(&at_3, &at_own, &SkyConfig::default()).is_ok());
    assert_eq!(read_for(&unknown, 10e6, MapFrequency::MustMatch, true).unwrap(), map(4));
    let said = read_for(&unknown, 10e6, scaled, true).unwrap_err().to_string();
    assert!(said.contains("FREQ is missing"), "{said}");
    for rule in [MapFrequency::MustMatch, scaled] {
        let said = read_for(&worded, 10e6, rule, true).unwrap_err().to_string();
        assert!(
            said.contains("FREQ") && said.contains("about 3 MHz") && said.contains("a positive number"),
            "{said}"
        );
    }
}
