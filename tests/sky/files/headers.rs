//! What the headers of maps by other software say, and how they say it.

use super::*;

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
