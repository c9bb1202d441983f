//! Map files: round trips, error messages, and hostile files.

use std::fs;
use std::io::Cursor;
use std::path::Path;

use lunarray::sky::fits::{
    Card, CardValue, Column, FitsError, FitsProblem, MapFile, MapOutline, Ordering, Precision, ReadOptions,
    SkyChannel, WriteOptions, check_frequency, read_known_sky, read_map, read_map_file, read_map_from,
    read_notes, read_prior, read_sky, read_whole_map, sky_notes, write_columns, write_map,
};
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

/// A card of a header.
fn card(text: &str) -> String {
    format!("{text:<80}")
}

/// A unit of a file: header and data, each in whole blocks.
fn unit_of(cards: &[&str], data: &[u8]) -> Vec<u8> {
    let mut header: String = cards.iter().map(|text| card(text)).collect();
    header.push_str(&card("END"));
    let mut bytes = header.into_bytes();
    bytes.resize(bytes.len().next_multiple_of(2880), b' ');
    bytes.extend_from_slice(data);
    bytes.resize(bytes.len().next_multiple_of(2880), 0);
    bytes
}

/// A map of nside 1 of these columns (name, TUNIT, values), as other software writes them: what they are stands in the first header.
fn foreign_map(path: &Path, primary: &[&str], more: &[&str], columns: &[(&str, &str, [f32; 12])]) {
    let first = [
        &[
            "SIMPLE  =                    T",
            "BITPIX  =                    8",
            "NAXIS   =                    0",
        ],
        primary,
    ]
    .concat();
    let texts: Vec<String> = [
        "XTENSION= 'BINTABLE'".to_owned(),
        "BITPIX  =                    8".to_owned(),
        "NAXIS   =                    2".to_owned(),
        format!("NAXIS1  = {:>20}", 4 * columns.len()),
        "NAXIS2  =                   12".to_owned(),
        "PCOUNT  =                    0".to_owned(),
        "GCOUNT  =                    1".to_owned(),
        format!("TFIELDS = {:>20}", columns.len()),
    ]
    .into_iter()
    .chain(columns.iter().zip(1..).flat_map(|((name, unit, _), k)| {
        [format!("TTYPE{k}  = '{name}'"), format!("TFORM{k}  = 'E'"), format!("TUNIT{k}  = '{unit}'")]
    }))
    .collect();
    let table: Vec<&str> = texts.iter().map(String::as_str).chain(more.iter().copied()).collect();
    let rows: Vec<u8> =
        (0..12).flat_map(|row| columns.iter().flat_map(move |column| column.2[row].to_be_bytes())).collect();
    fs::write(path, [unit_of(&first, &[]), unit_of(&table, &rows)].concat()).unwrap();
}

#[test]
fn the_first_header_says_what_the_table_s_leaves_out() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("haslam.fits");
    let values: [f32; 12] = std::array::from_fn(|k| 20_000.0 + 1_000.0 * k as f32);
    let columns = [("TEMPERATURE", "mK", values), ("N_OBS", "counts", [1.0; 12])];
    foreign_map(
        &path,
        &["FREQ    = '408 MHz '", "SKYCOORD= 'Galactic'", "ORDERING= 'NESTED  '"],
        &["NSIDE   = 1"],
        &columns,
    );
    let said = read_for(&path, 10e6, MapFrequency::MustMatch, false).unwrap_err().to_string();
    assert!(said.contains("FREQ is 408 MHz; expected 10 MHz"), "{said}");
    let map = read_for(&path, 408e6, MapFrequency::MustMatch, false).unwrap();
    // At nside 1 both orders are the same.
    assert_eq!((map.frame(), map.values()[3]), (Frame::Galactic, 23.0));
    let understood = MapOutline::read(&path, &ReadOptions::default()).unwrap().to_string();
    for part in ["408 MHz", "Galactic frame", "mK", "column `TEMPERATURE` of 2", "nside 1", "mean 2.55"] {
        assert!(understood.contains(part), "{part}: {understood}");
    }
}

#[test]
fn what_the_header_calls_bad_is_no_temperature() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.fits");
    let mut values = [3e5_f32; 12];
    values[7] = -32_768.0;
    let write = |more: &[&str], value: f32| {
        let mut values = values;
        values[7] = value;
        foreign_map(&path, &["COORDSYS= 'G'"], &[&["NSIDE   = 1"], more].concat(), &[("T", "K", values)]);
    };
    write(&["BAD_DATA=             -32768.0"], -32_768.0);
    let said = read_whole_map(&path, &ReadOptions::default()).unwrap_err().to_string();
    assert!(said.contains("1 of 12 pixels have no usable value") && said.contains("pixel 7"), "{said}");
    // As other programs call it.
    for key in ["BADVAL", "BAD_VAL", "MISSVAL", "UNSEEN", "BLANK"] {
        write(&[&format!("{key:8}=               -32768")], -32_768.0);
        let said = read_whole_map(&path, &ReadOptions::default()).unwrap_err().to_string();
        assert!(said.contains("1 of 12 pixels have no usable value") && said.contains("pixel 7"), "{said}");
    }
    // Integers have BLANK as other tables have TNULL.
    let mut integers = [f32::from_bits(300_000); 12];
    integers[7] = f32::from_bits(9_999);
    foreign_map(&path, &["COORDSYS= 'G'"], &["NSIDE   = 1", "BLANK   = 9999"], &[("T", "K", integers)]);
    let mut bytes = fs::read(&path).unwrap();
    let at = bytes.windows(13).position(|text| text == b"TFORM1  = 'E'").unwrap();
    bytes[at + 11] = b'J';
    fs::write(&path, bytes).unwrap();
    let said = read_whole_map(&path, &ReadOptions::default()).unwrap_err().to_string();
    assert!(said.contains("1 of 12 pixels have no usable value") && said.contains("pixel 7"), "{said}");
    write(&[], -32_768.0);
    assert!(read_whole_map(&path, &ReadOptions::default()).is_ok());
    // Below 0 K without such a keyword is noted.
    let channel = SkyChannel { frequency_hz: 3e6, is_dark_accepted: false, is_file_shared: false };
    let notes = sky_notes(&path, &channel, &SkyConfig::default()).unwrap();
    assert!(
        notes.iter().any(|note| note.contains("1 of 12 pixels are below 0 K, down to -3.2768e4 K")),
        "{notes:?}"
    );
    write(&[], 1.0);
    let notes = sky_notes(&path, &channel, &SkyConfig::default()).unwrap();
    assert!(!notes.iter().any(|note| note.contains("below 0 K")), "{notes:?}");
    // UNSEEN in mK and in MK, for priors too.
    for scaled in [-1.6375e27, -1.6375e24, -1.6375e30] {
        write(&[], scaled);
        for said in [
            read_whole_map(&path, &ReadOptions::default()).unwrap_err().to_string(),
            read_prior(&path, &ReadOptions::default()).unwrap_err().to_string(),
        ] {
            assert!(said.contains("pixel 7") && said.contains("no usable value"), "{said}");
        }
    }
    write(&[], 2.5e20);
    let said = read_prior(&path, &ReadOptions::default()).unwrap_err().to_string();
    assert!(said.contains("no temperature of a sky") && said.contains("pixel 7"), "{said}");
}

#[test]
fn a_column_is_of_the_channel_that_it_names() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("three.fits");
    let columns =
        |names: [&'static str; 3]| [1.0_f32, 2.0, 3.0].map(|k| (names[k as usize - 1], "K", [k * 1e5; 12]));
    let write = |names| foreign_map(&path, &["COORDSYS= 'G'"], &["NSIDE   = 1"], &columns(names));
    write(["T_1MHz", "T_3MHz", "T_10.0MHz"]);
    let shared = |frequency_hz| SkyChannel { frequency_hz, is_dark_accepted: false, is_file_shared: true };
    for (hz, value) in [(1e6, 1e5), (3e6, 2e5), (10e6, 3e5)] {
        assert_eq!(read_sky(&path, &shared(hz), &SkyConfig::default()).unwrap().values()[0], value);
    }
    // The nearest is scaled, by the law of the configuration alone.
    let said = read_sky(&path, &shared(8e6), &SkyConfig::default()).unwrap_err().to_string();
    assert!(said.contains("TTYPE3 is 10 MHz; expected 8 MHz"), "{said}");
    let scaled = SkyConfig { frequency: MapFrequency::SpectralIndex(-2.0), ..SkyConfig::default() };
    let value = read_sky(&path, &shared(8e6), &scaled).unwrap().values()[0];
    assert!((value / (3e5 / 0.64) - 1.0).abs() < 1e-12, "{value}");
    // Columns that say nothing are noted.
    write(["T", "Q", "U"]);
    let notes = read_notes(&path, &ReadOptions::default()).unwrap();
    assert!(
        notes.iter().any(|note| note.contains("3 columns") && note.contains("`T`, the first")),
        "{notes:?}"
    );
    // One that is chosen, and nothing else of it is believed.
    let chosen = |column| SkyConfig { column: Some(column), ..SkyConfig::default() };
    let own = |frequency_hz| SkyChannel { frequency_hz, is_dark_accepted: false, is_file_shared: false };
    let read = |column| read_sky(&path, &own(3e6), &chosen(column)).map(|map| map.values()[0]);
    write(["I_ML", "I_MEAN", "I_RMS"]);
    assert_eq!((read(0).unwrap(), read(1).unwrap()), (1e5, 2e5));
    let options = ReadOptions { column: Some(1), ..ReadOptions::default() };
    assert!(read_notes(&path, &options).unwrap().iter().all(|note| !note.contains("columns")));
    for (column, said) in [(2, "I_RMS"), (3, "no map column 3 (counted from 0); expected one of its 3")] {
        let found = read(column).unwrap_err().to_string();
        assert!(found.contains(said), "{found}");
    }
    write(["T_1MHz", "T_3MHz", "T_10MHz"]);
    assert!(read(2).unwrap_err().to_string().contains("TTYPE3 is 10 MHz; expected 3 MHz"));
}

#[test]
fn errors_hits_and_polarisation_are_no_sky() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("columns.fits");
    let columns = |names: [&'static str; 2]| [(names[0], "", [70.0_f32; 12]), (names[1], "K", [3e5; 12])];
    let primary = ["COORDSYS= 'G'", "FREQ    = '10 MHz'"];
    let write = |primary: &[&str], names| foreign_map(&path, primary, &["NSIDE   = 1"], &columns(names));
    for names in [
        ["SIGMA_10MHz", "T_10MHz"],
        ["SIGMA", "T"],
        ["N_OBS", "TEMPERATURE"],
        ["HITS", "T"],
        ["PIXEL", "T"],
        ["Q_POLARISATION", "I_STOKES"],
        ["UNCERTAINTY", "T"],
        ["SENSITIVITY", "T"],
        ["LOG_T", "T"],
    ] {
        write(&primary, names);
        let sky = read_for(&path, 10e6, MapFrequency::MustMatch, false).unwrap();
        let prior = read_prior(&path, &ReadOptions::default()).unwrap().map;
        for map in [&sky, &prior, &read_known_sky(&path, &ReadOptions::default()).unwrap()] {
            assert_eq!(map.values()[0], 3e5, "{names:?}");
        }
    }
    // Two columns of one frequency, and columns that are errors and numbers only.
    write(&primary[..1], ["T_10MHz", "T2_10MHz"]);
    let said = read_for(&path, 10e6, MapFrequency::MustMatch, false).unwrap_err().to_string();
    assert!(said.contains("TTYPE1 is 10 MHz; expected one column of that frequency; TTYPE2"), "{said}");
    write(&primary, ["SIGMA", "N_OBS"]);
    let said = read_for(&path, 10e6, MapFrequency::MustMatch, false).unwrap_err().to_string();
    assert!(said.contains("SIGMA; expected the name of a map"), "{said}");
    // What columns say and what the file says.
    write(&["COORDSYS= 'G'", "FREQ    = '3 MHz'"], ["T_10MHz", "HITS"]);
    let said = read_for(&path, 10e6, MapFrequency::MustMatch, false).unwrap_err().to_string();
    assert!(said.contains("FREQ is 3 MHz; expected 10 MHz, as TTYPE1 says"), "{said}");
    // The keyword that states the frequency is named.
    write(&["COORDSYS= 'G'", "OBSFREQ = 408. / MHz"], ["T", "HITS"]);
    let said = read_for(&path, 10e6, MapFrequency::MustMatch, false).unwrap_err().to_string();
    assert!(said.contains("OBSFREQ is 408 MHz"), "{said}");
}

#[test]
fn headers_agree_on_order_and_size() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("orders.fits");
    let write = |primary: &[&str], more: &[&str]| {
        foreign_map(&path, &[&["COORDSYS= 'G'"], primary].concat(), more, &[("T", "K", [3e5; 12])]);
    };
    let refused = || read_map(&path, &ReadOptions::default()).unwrap_err().to_string();
    write(&["ORDERING= 'NESTED'"], &["NSIDE   = 1", "ORDERING= 'RING'"]);
    let said = refused();
    assert!(said.contains("ORDERING is 'NESTED'; expected 'RING', as the headers say elsewhere"), "{said}");
    write(&["NSIDE   = 2"], &["NSIDE   = 1"]);
    let said = refused();
    assert!(said.contains("NSIDE is 2; expected 1, as the headers say elsewhere"), "{said}");
    let assumed = |notes: &[String]| {
        notes.iter().any(|note| note.contains("ORDERING") && note.contains("RING is assumed"))
    };
    for (cards, shown) in [
        (&["NSIDE   = 1", "ORDERING= 'nest'"][..], "nside 1 in NESTED order"),
        (&["NSIDE   = 1", "ORDERING= 'RING'"], "nside 1 in RING order ("),
        (&["NSIDE   = 1"], "nside 1 in RING order (assumed)"),
    ] {
        write(&[], cards);
        let understood = MapOutline::read(&path, &ReadOptions::default()).unwrap().to_string();
        assert!(understood.contains(shown), "{understood}");
        let notes = read_notes(&path, &ReadOptions::default()).unwrap();
        assert_eq!(assumed(&notes), cards.len() == 1, "{notes:?}");
    }
}

#[test]
fn a_frequency_in_other_words_counts() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("words.fits");
    let write = |primary: &[&str], more: &[&str]| {
        let more = [&["NSIDE   = 1"], more].concat();
        foreign_map(&path, &[&["COORDSYS= 'G'"], primary].concat(), &more, &[("T", "K", [3e5; 12])]);
    };
    let read = |hz| read_for(&path, hz, MapFrequency::MustMatch, false).map_err(|error| error.to_string());
    let noted = |words: &str| {
        let notes = read_notes(&path, &ReadOptions::default()).unwrap();
        notes.iter().any(|note| note.contains(words))
    };
    for (primary, more, said) in [
        (&["CTYPE3  = 'FREQ'", "CRVAL3  = 408.", "CUNIT3  = 'MHz'"][..], &[][..], "CRVAL3 is 408 MHz"),
        (&[], &["FREQ_MHZ= 408"], "FREQ_MHZ is 408 MHz"),
        // Long keywords as astropy writes them, and those of Planck's components and of receivers.
        (&["HIERARCH FREQUENCY = 408.0 / [MHz]"], &[], "FREQUENCY is 408 MHz"),
        (&[], &["HIERARCH map frequency = '408 MHz'"], "map frequency is 408 MHz"),
        (&[], &["NU_REF  = '408.0 MHz'"], "NU_REF is 408 MHz"),
        (&[], &["CENTFREQ= 408.0 / central frequency [MHz]"], "CENTFREQ is 408 MHz"),
        (&["REFFREQ = 4.08E8"], &["FREQ0   = 408000.0 / kHz"], "FREQ0 is 408 MHz"),
    ] {
        write(primary, more);
        let found = read(10e6).unwrap_err();
        assert!(found.contains(said) && found.contains("expected 10 MHz"), "{found}");
        assert!(read(408e6).is_ok() && !noted("states no frequency"));
    }
    // Texts: one frequency that is another is refused, unless FREQ says better.
    for (text, keyword) in [
        ("EXTNAME = 'HASLAM_408MHZ'", "EXTNAME"),
        ("TCOMM1  = 'temperature at 408 MHz'", "TCOMM1"),
        ("BAND    = '408 MHz'", "BAND"),
        ("COMMENT   All-sky 408 MHz map", "COMMENT"),
        ("HISTORY   All-sky 408 MHz map, destriped", "HISTORY"),
    ] {
        write(&[], &[text]);
        let found = read(10e6).unwrap_err();
        for part in [keyword, "408", "expected 10 MHz, the channel's", "as FREQ in its header"] {
            assert!(found.contains(part), "{found}: expected {part}");
        }
        let found = check_frequency(&path, 10e6, &ReadOptions::default()).unwrap_err().to_string();
        assert!(found.contains(keyword), "{found}");
        assert!(read(408e6).is_ok() && noted(&format!("in {keyword}; it is taken as one at the channel's")));
        write(&["FREQ    = '10 MHz'"], &[text]);
        assert!(read(10e6).is_ok());
    }
    // FREQ counts before others, and widths, steps and ends of bands are no frequencies of maps.
    for others in [
        &["FREQ    = '10 MHz'", "FREQ_REF= 408.0 / MHz"][..],
        &["FREQMIN = 9E6", "FREQMAX = 11E6", "FREQRES = 24E3 / Hz", "FREQ_BW = '408 kHz'", "NFREQ   = 3"],
        &["OBS_FREQ= 22E6 / width of a channel, Hz"],
        &["SAMPFREQ= 2E8 / Hz", "DFREQ   = 1E5 / Hz", "CALFREQ = '408 MHz'"],
    ] {
        write(others, &[]);
        assert_eq!(
            (read(10e6).is_ok(), noted("states no frequency")),
            (true, others.len() != 2),
            "{others:?}"
        );
    }
    // A reference beside columns that say their own.
    let reference = [&["COORDSYS= 'G'", "NU_REF  = '408 MHz'"][..], &["NSIDE   = 1"]];
    foreign_map(&path, reference[0], reference[1], &[("T_10MHz", "K", [3e5; 12])]);
    assert!(read(10e6).is_ok() && read(408e6).is_err());
    write(&["FREQ_OBS= '22 MHz'", "FREQ_REF= '408 MHz'"], &[]);
    assert!(read(10e6).is_ok() && noted("its header says '22 MHz' in FREQ_OBS"));
    write(&[], &["COMMENT   from 22 MHz and 408 MHz"]);
    assert!(read(10e6).is_ok() && noted("its header says 'from 22 MHz and 408 MHz' in COMMENT"));
}

#[test]
fn a_compressed_image_is_no_map() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("image.fits");
    // Its tiles are rows of a table, as fpack and astropy write them.
    let image = ["ZIMAGE  =                    T", "ZCMPTYPE= 'RICE_1'"];
    foreign_map(&path, &["COORDSYS= 'G'"], &image, &[("ZSCALE", "", [3e5; 12])]);
    let said = read_map(&path, &ReadOptions::default()).unwrap_err().to_string();
    assert!(said.contains("no binary table of a map among its 2 units"), "{said}");
}

#[test]
fn numbers_in_quotes_are_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("quoted.fits");
    let mut values = [3e5_f32; 12];
    values[7] = -9999.0;
    let read = |more: &[&str]| {
        foreign_map(&path, &["COORDSYS= 'G'"], &[&["NSIDE   = 1"], more].concat(), &[("T", "K", values)]);
        read_whole_map(&path, &ReadOptions::default()).map_err(|error| error.to_string())
    };
    for card in ["BAD_DATA= '-9999'", "BAD_DATA= '-9999.0 '", "BAD_DATA= -9999"] {
        let said = read(&[card]).unwrap_err();
        assert!(said.contains("1 of 12 pixels") && said.contains("pixel 7 with -9.999e3"), "{said}");
    }
    assert_eq!(read(&["TSCAL1  = '100'", "TZERO1  = '1'"]).unwrap().values()[0], 30_000_001.0);
    for card in ["BAD_DATA= 'below 0'", "TSCAL1  = 'ten'", "TNULL1  = 'none'"] {
        let said = read(&[card]).unwrap_err();
        assert!(said.contains(&card[..6]) && said.contains("expected a"), "{said}");
    }
}

#[test]
fn a_frame_is_said_once_and_of_j2000() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("frames.fits");
    let read = |primary: &[&str], more: &[&str]| {
        foreign_map(&path, primary, &[&["NSIDE   = 1"], more].concat(), &[("T", "K", [3e5; 12])]);
        read_map(&path, &ReadOptions::default()).map(|map| map.frame()).map_err(|error| error.to_string())
    };
    for (primary, table, said) in [
        (
            &["COORDSYS= 'C'"][..],
            &["COORDSYS= 'G'"][..],
            "COORDSYS is 'C'; expected Galactic, as the headers say",
        ),
        (&["SKYCOORD= 'Equatorial'"], &["COORDSYS= 'G'"], "SKYCOORD is 'Equatorial'"),
        (&["COORDSYS= 'C'"], &["EQUINOX =               1950.0"], "EQUINOX is 1950.0; expected 2000"),
        (&["COORDSYS= 'C'"], &["EQUINOX = 'B1950'"], "EQUINOX is 'B1950'"),
        (&["COORDSYS= 'E'"], &["RADECSYS= 'FK4'"], "RADECSYS is 'FK4'"),
        (&["COORDSYS= 'C'"], &["EPOCH   =               1950.0"], "EPOCH is 1950.0"),
    ] {
        let found = read(primary, table).unwrap_err();
        assert!(found.contains(said), "{found}: expected {said}");
    }
    let galactic = read(&["COORDSYS= 'G'", "SKYCOORD= 'Galactic'"], &["EQUINOX = 1950.0"]);
    assert_eq!(galactic, Ok(Frame::Galactic));
    assert_eq!(read(&["COORDSYS= 'C'"], &["EQUINOX = 2000.", "EPOCH = 1982.5"]), Ok(Frame::Equatorial));
}

#[test]
fn the_table_with_the_map_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let [path, second] = ["first.fits", "second.fits"].map(|name| folder.path().join(name));
    foreign_map(&path, &["COORDSYS= 'G'"], &["EXTNAME = 'LOG'"], &[("X", "s", [1.0; 12])]);
    foreign_map(&second, &[], &["NSIDE   = 1"], &[("T", "K", [3e5; 12])]);
    let [log, map] = [&path, &second].map(|path| fs::read(path).unwrap());
    fs::write(&path, [&log, &map[2880..]].concat()).unwrap();
    assert_eq!(read_map(&path, &ReadOptions::default()).unwrap().values()[0], 3e5);
    // A table that says nothing of HEALPix is read where no other does, whatever follows it.
    fs::write(&path, [&log, &map[2880..4000]].concat()).unwrap();
    assert_eq!(read_map(&path, &ReadOptions::default()).unwrap().values()[0], 1.0);
}
