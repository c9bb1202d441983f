use super::*;

fn file(text: &[u8]) -> tempfile::NamedTempFile {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), text).unwrap();
    file
}

/// Ecliptic longitude and latitude, degrees.
fn place(source: &Source) -> [f64; 2] {
    let [x, y, z] = source.direction;
    [y.atan2(x).to_degrees().rem_euclid(360.0), z.asin().to_degrees()]
}

#[test]
fn positions_of_all_frames_are_one_place() {
    // Cassiopeia A: RA 23h23m26s, Dec +58d48m (FK5), by astropy in the other frames.
    let (galactic, ecliptic) = ([111.733_805_2, -2.145_148_7], [27.366_809_7, 54.837_230_0]);
    let tables = [
        "name,ra,dec,S74\nCas A,350.85833,58.8000,17690\n".to_owned(),
        "\u{feff}Name;RAJ2000;DEJ2000;S74\n\"Cas A\";23:23:26.0;+58:48:00;17690\n".to_owned(),
        "#RA (J2000)\n#\n#Name\tRAJ2000\tDEJ2000\tS74\nCas A\t23 23 26.0\t+58 48 00\t17690\n".to_owned(),
        "Name|RAJ2000|DEJ2000|S74\n|\"h:m:s\"|\"d:m:s\"|mJy\n-----|----|----|----\nCas A|23h23m26s|58d48m|17690000\n".to_owned(),
        "RAh,RAm,RAs,DE-,DEd,DEm,DEs,S74\n23,23,26,+,58,48,0,17690\n".to_owned(),
        format!("GLON,GLAT,flux_74_mhz\n{},{},17690\n", galactic[0], galactic[1]),
        format!("elon elat S74\n{} {} 17690\n", ecliptic[0], ecliptic[1]),
        "ra;dec;S74\n350,85833;58,8;17690\n".to_owned(),
    ];
    for table in &tables {
        let read = Catalogue::read(file(table.as_bytes()).path()).unwrap();
        let [source] = read.sources[..] else { panic!("{table}") };
        assert!((source.flux_jy / 17_690.0 - 1.0).abs() < 1e-12 && source.at_hz == 74e6, "{table}");
        let found = place(&source);
        // Right ascensions in the tables have four decimals of a degree.
        let apart = (found[0] - ecliptic[0]).abs().max((found[1] - ecliptic[1]).abs());
        assert!(apart < 1e-4, "{table}: {found:?}");
    }
}

#[test]
fn sources_that_are_not_fitted_have_the_common_index() {
    let table = "GLEAM,RAJ2000,DEJ2000,Fintwide,Fint076,alpha\nA,10,-20,1.5,2,-0.7\nB,11,-21,0.5,1,\nC,12,-22,0.4,1,NaN\n";
    let read = Catalogue::read(file(table.as_bytes()).path()).unwrap();
    let indices: Vec<_> = read.sources.iter().map(|source| source.index).collect();
    assert_eq!(indices, [Some(-0.7), None, None]);
    assert!(read.sources.iter().all(|source| source.at_hz == 200e6));
    // The flux of the fit, or the wide-band one where there is none, both at 200 MHz.
    let fitted = "Name,ra,dec,int_flux_wide,alpha,int_flux_fit_200\nA,10,-20,1.5,-0.7,1.25\nB,11,-21,0.5,,\nC,12,-22,0.4,NaN,NaN\n";
    let fluxes = Catalogue::read(file(fitted.as_bytes()).path()).unwrap().sources;
    let fluxes: Vec<_> = fluxes.iter().map(|source| (source.flux_jy, source.at_hz)).collect();
    assert_eq!(fluxes, [(1.25, 200e6), (0.5, 200e6), (0.4, 200e6)]);
    let other = fitted.replace("int_flux_wide", "int_flux_wide (mJy)");
    let said = Catalogue::read(file(other.as_bytes()).path()).unwrap_err().to_string();
    assert!(
        said.contains("another unit of `int_flux_wide (mJy)`, expected the unit of `int_flux_fit_200`"),
        "{said}"
    );
    let said = read.to_string();
    for part in ["3 sources", "equatorial", "`Fintwide` (Jy) at 200", "2.4000e0 Jy", "`alpha` of 1"] {
        assert!(said.contains(part), "{part}: {said}");
    }
}

#[test]
fn indices_of_the_other_sign_are_noted() {
    let note = |indices: [&str; 3]| {
        let rows: String = indices.iter().map(|index| format!("1,2,3,{index}\n")).collect();
        Catalogue::read(file(format!("ra,dec,S74,alpha\n{rows}").as_bytes()).path()).unwrap().note()
    };
    let noted = note(["0.7", "0.8", "-0.1"]).unwrap();
    assert!(noted.contains("2 of 3 spectral indices `alpha` are above 0, with S ~ nu^alpha"), "{noted}");
    assert_eq!(
        (note(["-0.7", "0.8", "-0.1"]), note(["0.7", "-0.7", ""]), note(["", "", ""])),
        (None, None, None)
    );
}

#[test]
fn a_flux_is_of_its_row_s_frequency() {
    for flux in ["flux_mjy", "flux (mJy)", "S [mJy]"] {
        let table = format!("l,b,{flux},frequency_mhz\n1,2,300,151\n1,2,400,408\n");
        let read = Catalogue::read(file(table.as_bytes()).path()).unwrap();
        let found: Vec<_> = read.sources.iter().map(|one| (one.flux_jy, one.at_hz)).collect();
        assert_eq!(found, [(0.3, 151e6), (0.4, 408e6)], "{flux}");
    }
}

#[test]
fn the_row_of_units_is_what_numbers_are_in() {
    // 60 deg of longitude and 30 deg of latitude, 5 Jy.
    for table in [
        "elon,elat,S74\ndeg,deg,Jy\n60,30,5\n",
        "elon,elat,S74\nrad,rad,mJy\n1.0471975512,0.5235987756,5000\n",
        "elon,elat,S74\narcmin,arcsec,Jy\n3600,108000,5\n",
        "elon (rad),elat [deg],S74\n1.0471975512,30,5\n",
        "elon,elat,S74\nhours,,\n4,30,5\n",
        "elon,elat,S74\n60,30,5,\n",
    ] {
        let read = Catalogue::read(file(table.as_bytes()).path()).unwrap();
        let [longitude, latitude] = place(&read.sources[0]);
        let off = (longitude - 60.0).abs().max((latitude - 30.0).abs());
        // Angles in radians have eleven digits.
        assert!(off < 1e-8 && (read.sources[0].flux_jy - 5.0).abs() < 1e-12, "{table}");
    }
    // Hours are of right ascension as well, without a colon.
    let read = Catalogue::read(file(b"ra,dec,S74\nhours,deg,Jy\n12,0,5\n").path()).unwrap();
    let longitude = place(&read.sources[0])[0];
    // The origin of ICRS is 0.02 arc seconds off the equinox of J2000.
    assert!((longitude - 180.0).abs() < 1e-5, "{longitude}");
    // Units in comments: of ECSV in one line or several, in brackets, and in words.
    let ecsv = "# %ECSV 1.0\n# ---\n# datatype:\n";
    for (comments, row) in [
        (
            format!(
                "{ecsv}# - {{name: elon, unit: hourangle, datatype: float64}}\n# - {{name: S74, unit: mJy}}\n"
            ),
            "4,30,5000",
        ),
        (format!("{ecsv}# -\n#   name: S74\n#   unit: 'mJy'\n#   datatype: float64\n"), "60,30,5000"),
        ("# elon [rad], elat [deg], S74 [mJy]\n".to_owned(), "1.0471975512,30,5000"),
        ("# elon: longitude (arcmin)\n# S74 of [3]\n# S74 (mJy)\n".to_owned(), "3600,30,5000"),
        ("# positions in degrees and fluxes in mJy\n".to_owned(), "60,30,5000"),
        ("# elon in hours\n# flux of others [mJy]\n# S74 [Jy]\n".to_owned(), "4,30,5"),
    ] {
        let table = format!("{comments}elon,elat,S74\n{row}\n");
        let read = Catalogue::read(file(table.as_bytes()).path()).unwrap();
        let [longitude, latitude] = place(&read.sources[0]);
        let off = (longitude - 60.0).abs().max((latitude - 30.0).abs());
        assert!(off < 1e-8 && (read.sources[0].flux_jy - 5.0).abs() < 1e-12, "{table}");
    }
    for (table, said) in [
        ("# - {name: S74, unit: uJy}\nelon,elat,S74\n1,2,3\n", "the unit `ujy` of `S74`"),
        ("# - {name: elat, unit: hourangle}\nelon,elat,S74\n1,2,3\n", "the unit `hourangle` of `elat`"),
        ("# S74 [mJy]\nelon,elat,S74\ndeg,deg,Jy\n1,2,3\n", "`jy` of `S74`"),
        ("# - {name: S74, unit: dex(Jy)}\nelon,elat,S74\n1,2,3\n", "of `S74`, expected a flux density"),
        (
            "elon,elat,S74\n,,[Jy]\n1,2,3\n",
            "the unit `[Jy]` of `S74`, expected a flux density: brackets mean its logarithm",
        ),
        ("elon_deg,elat,S74\nrad,deg,Jy\n1,2,3\n", "line 1: found the unit `rad` of `elon_deg`"),
        ("elon,elat,S74\ndeg,hours,Jy\n1,2,3\n", "the unit `hours` of `elat`"),
        ("elon,elat,S74\ndeg,gon,Jy\n1,2,3\n", "the unit `gon` of `elat`"),
        ("elon,elat,flux_154mhz_mjy\ndeg,deg,Jy\n1,2,3\n", "the unit `jy` of `flux_154mhz_mjy`"),
        ("l,b,flux_jy,frequency_mhz\ndeg,deg,Jy,GHz\n1,2,3,0.154\n", "the unit `ghz` of `frequency_mhz`"),
    ] {
        let found = Catalogue::read(file(table.as_bytes()).path()).unwrap_err().to_string();
        assert!(found.contains(said), "{found}: expected {said}");
    }
}

#[test]
fn catalogues_that_are_none_say_where() {
    let said = |text: &[u8]| Catalogue::read(file(text).path()).unwrap_err().to_string();
    let head = "ecliptic_longitude_deg,ecliptic_latitude_deg,flux_154mhz_jy";
    let found = said(b"a,b\n1,2");
    assert!(found.contains("line 1: found the columns a, b, expected columns of longitude"), "{found}");
    assert!(said(b"").contains("no columns"));
    assert!(said(b"\x1f\x8b\x08").contains("gzip"));
    assert!(said(b"<?xml version='1.0'?><VOTABLE/>").contains("VOTable"));
    assert!(said(b"ra,dec,S74 (K)\n1,2,3\n").contains("the unit `k` of `S74 (K)`"));
    // The names may be a comment.
    assert!(said(b"# J2000\n# a,b\n1,2\n").contains("line 2: found the columns a, b"));
    assert!(
        said(b"# of 2020\n\n# ra,dec,S74,S74\n1,2,3,4\n# end\n").contains("line 3: found several columns")
    );
    assert!(said(b"# ra,dec,\"S74\n1,2,3\n").contains("line 1: found a quote that is not closed"));
    assert!(
        said(b"name,ra,dec,S74\n\"A\",1,2,3\n\"B,1,2,3\n")
            .contains("line 3: found a quote that is not closed")
    );
    assert!(said(b"ra,dec,S74\n\"deg,deg,mJy\n1,2,3\n").contains("line 2: found a quote that is not closed"));
    // No sources, other line ends, cells beyond the names, and what no source has.
    assert!(said(b"ra,dec,S74\n").contains("no sources"));
    assert!(said(b"ra,dec,S74\r10,20,5\r11,21,x\r").contains("line 3: found \"x\" as S74"));
    assert!(said(b"ra,dec,S74\n10,5,20,5,3\n").contains("line 2: found 5 cells, expected 3"));
    assert!(said(b"ra,dec,S74,S74\n10,20,5,7\n").contains("several columns `S74`"));
    assert!(said(b"ra,dec,S74\n1,2,1e300\n").contains("line 2: found 1e300 Jy, expected at most 1e12"));
    let found = said(b"ra,dec,flux_jy,frequency_mhz\n1,2,3,154e6\n");
    assert!(found.contains("line 2: found a flux at 1.54e14 Hz"), "{found}");
    let found = said(b"# Name\n# Equinox B1950\nra,dec,S74\n1,2,3\n");
    assert!(found.contains("line 2: found positions of B1950"), "{found}");
    for (table, line) in [
        ("# Equinox: 1950\nra,dec,S74\n1,2,3\n", 1),
        ("#\n# epoch 1950.0 coordinates\nra,dec,S74\n1,2,3\n", 2),
        ("ra,dec,S74,equinox\n1,2,3,J2000\n1,2,3,B1950\n", 3),
        ("RA(1950),DEC(1950),S74\n1,2,3\n", 1),
    ] {
        let found = said(table.as_bytes());
        assert!(found.contains(&format!("line {line}: found positions of B1950")), "{found}");
    }
    assert!(Catalogue::read(file(b"# found in 1950\nra,dec,S74,epoch\n1,2,3,1982.5\n").path()).is_ok());
    assert!(Catalogue::read(file(b"# names of B1950\nRAJ2000,DEJ2000,S74\n1,2,3\n").path()).is_ok());
    // Forms are named.
    assert!(said(b"\x28\xb5\x2f\xfd\0").contains("a zstd file"));
    assert!(said(b"r\0a\0,\0").contains("UTF-16"));
    for (row, words) in [
        ("1,2,x", "found \"x\" as flux_154mhz_jy, expected a flux density"),
        ("1,2,-3", "above 0"),
        ("1,91,3", "-90 to 90"),
        ("NaN,1,3", "a longitude"),
        ("1,2", "found \"\" as flux_154mhz_jy"),
        ("10:61:00,2,3", "a longitude"),
    ] {
        let found = said(format!("{head}\n0,0,1\n{row}\n").as_bytes());
        assert!(found.contains("line 3") && found.contains(words), "{found}");
    }
    assert!(matches!(Catalogue::read(Path::new("/nowhere/x.csv")), Err(CatalogueError::Read { .. })));
}
