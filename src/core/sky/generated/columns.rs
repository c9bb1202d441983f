//! Recognition of the columns of a published catalogue by name: positions, fluxes and spectral indices.

use super::sources::COUNTS_HZ;
use crate::sky::Frame;

/// Frequency of GLEAM's wide-band fluxes and fits, Hz.
const GLEAM_WIDE_HZ: f64 = 200e6;

const VLSSR_HZ: f64 = 73.8e6;

/// Names of longitude and latitude columns in each frame, without case and punctuation.
const POSITIONS: [(Frame, &[&str], &[&str]); 3] = [
    (
        Frame::Ecliptic,
        &["eclipticlongitudedeg", "eclipticlongitude", "elon", "eclon", "elondeg", "lambda"],
        &["eclipticlatitudedeg", "eclipticlatitude", "elat", "eclat", "elatdeg", "beta"],
    ),
    (
        Frame::Equatorial,
        &["raj2000", "ra2000", "rajd", "ra", "radeg", "raicrs", "rightascension", "alphaj2000"],
        &[
            "dej2000",
            "decj2000",
            "dec2000",
            "dejd",
            "dec",
            "de",
            "decdeg",
            "dedeg",
            "deicrs",
            "decicrs",
            "declination",
            "deltaj2000",
        ],
    ),
    (
        Frame::Galactic,
        &["glon", "galacticlongitude", "galacticlongitudedeg", "gallon", "glondeg", "lii", "l"],
        &["glat", "galacticlatitude", "galacticlatitudedeg", "gallat", "glatdeg", "bii", "b"],
    ),
];

/// Names of VizieR's separate columns of J2000 positions: hours, minutes and seconds; sign, degrees, minutes and seconds.
const PARTS: [&[&str]; 2] = [&["rah", "ram", "ras"], &["de-", "ded", "dem", "des"]];

const INDICES: [&str; 8] =
    ["spectralindex", "alpha", "spindex", "specindex", "spidx", "spix", "alphafit", "spectralindexfit"];

/// Indices of the columns that describe a source.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct SourceColumns {
    /// Frame of positions.
    pub frame: Frame,
    /// Columns of longitude and of latitude; several where hours or degrees, minutes and seconds are separate.
    pub places: [Vec<usize>; 2],
    /// Column of the flux.
    pub flux: usize,
    /// Column of the wide-band flux at the same frequency, for sources whose flux is not fitted.
    pub unfitted_flux: Option<usize>,
    /// Frequency of the flux, Hz; NaN if each source has its own in `frequency_place`.
    pub flux_hz: f64,
    /// Column with each flux's frequency, and its unit, Hz.
    pub frequency_place: Option<(usize, f64)>,
    /// Column of spectral indices.
    pub index: Option<usize>,
}

/// GLEAM's names of its flux densities at 200 MHz: of spectra that are fitted, and of the wide band.
const FITTED: [&str; 2] = ["intfluxfit200", "fintfit200"];
const WIDE: [&str; 2] = ["intfluxwide", "fintwide"];

/// Converts a name to lower case without punctuation, except decimal points.
pub(super) fn normalise(name: &str) -> String {
    let name = name.split(['(', '[']).next().unwrap_or(name);
    let kept: String = name.chars().filter(|c| c.is_ascii_alphanumeric() || *c == '.').collect();
    kept.trim_matches('.').to_ascii_lowercase()
}

impl SourceColumns {
    /// Recognises the columns of a catalogue by their names; the error is the expected columns. Flux columns of VLSSr do not contain
    /// the frequency in their name.
    pub(super) fn recognise(names: &[String], is_vlssr: bool) -> Result<Self, String> {
        let normalised_names: Vec<String> = names.iter().map(|name| normalise(name)).collect();
        let place = |accepted: &str| normalised_names.iter().position(|name| name == accepted);
        let one_of = |accepted: &[&str]| accepted.iter().find_map(|name| place(name));
        let joined = || {
            let part = |accepted: &[&str]| -> Vec<usize> {
                let at = |name: &&str| match *name {
                    // The column of the sign is the only name with punctuation.
                    "de-" => names.iter().position(|found| found.trim().eq_ignore_ascii_case("de-")),
                    name => place(name),
                };
                accepted.iter().filter_map(at).collect()
            };
            let [ra, dec] = PARTS.map(part);
            (ra.len() == 3 && dec.len() >= 3).then_some((Frame::Equatorial, [ra, dec]))
        };
        let whole = POSITIONS
            .iter()
            .find_map(|(frame, lon, lat)| Some((*frame, [vec![one_of(lon)?], vec![one_of(lat)?]])));
        let Some((frame, places)) = whole.or_else(joined) else {
            let old = normalised_names.iter().any(|name| name.contains("1950"));
            let old = if old { "; positions of B1950 are to be precessed first" } else { "" };
            return Err(format!(
                "columns of longitude and latitude: ecliptic_longitude_deg and ecliptic_latitude_deg, RAJ2000 and DEJ2000 (or ra, dec), or \
                 GLON and GLAT (or l, b){old}"
            ));
        };
        let index = one_of(&INDICES);
        let hz = normalised_names.iter().enumerate().find_map(|(k, name)| {
            let unit = match name.as_str() {
                "frequencyhz" | "freqhz" => 1.0,
                "frequencymhz" | "freqmhz" | "numhz" => 1e6,
                _ => return None,
            };
            Some((k, unit))
        });
        let Some((flux, flux_hz)) = flux_of(&normalised_names, index.is_some(), hz.is_some(), is_vlssr)
        else {
            return Err("a column of flux densities that names its frequency, such as flux_154mhz_jy, S74, int_flux_wide or Fintwide of \
                 GLEAM, Si of VLSSr, or flux_jy with a column frequency_mhz"
                .to_owned());
        };
        let own = flux_hz.is_nan();
        let frequency_place = hz.filter(|_| own);
        let is_fitted = FITTED.iter().any(|name| normalised_names[flux].starts_with(name));
        let unfitted_flux = one_of(&WIDE).filter(|_| is_fitted);
        Ok(Self { frame, places, flux, unfitted_flux, flux_hz, frequency_place, index })
    }
}

/// Returns the column of fluxes and its frequency, Hz; NaN if the frequencies are in another column.
///
/// The first choice is the column that this program writes, then the one that belongs to fitted indices, then that of the lowest
/// frequency.
fn flux_of(names: &[String], has_index: bool, has_frequency: bool, is_vlssr: bool) -> Option<(usize, f64)> {
    let base = |name: &String| name.trim_end_matches("mjy").trim_end_matches("jy").to_owned();
    let bases: Vec<String> = names.iter().map(base).collect();
    let at =
        |accepted: &[&str]| accepted.iter().find_map(|name| bases.iter().position(|found| found == name));
    if let Some(own) = at(&["flux154mhz"]) {
        return Some((own, COUNTS_HZ));
    }
    let wide = at(&[FITTED, WIDE].concat());
    if let Some(wide) = wide.filter(|_| has_index) {
        return Some((wide, GLEAM_WIDE_HZ));
    }
    let of_frequency = |(k, name): (usize, &String)| Some((k, flux_hz(name)?));
    let lowest = names.iter().enumerate().filter_map(of_frequency).min_by(|(_, a), (_, b)| a.total_cmp(b));
    let is_vlssr = is_vlssr || names.iter().any(|name| name.starts_with("vlss"));
    let vlssr = at(&["si", "sint", "flux", "sp"]).filter(|_| is_vlssr);
    let any = at(&["flux", "s", "sint", "intflux", "totalflux"]).filter(|_| has_frequency);
    any.map(|k| (k, f64::NAN))
        .or(lowest)
        .or(wide.map(|k| (k, GLEAM_WIDE_HZ)))
        .or(vlssr.map(|k| (k, VLSSR_HZ)))
}

/// Parses the frequency in the name of a flux column, Hz, such as `flux_74_mhz`, `S408`, `Fint076`, `int_flux_084`, `S_1.4GHz`.
fn flux_hz(name: &str) -> Option<f64> {
    const KINDS: [&str; 9] = ["s", "f", "si", "fint", "flux", "intflux", "sint", "totalflux", "fluxint"];
    let name = name.trim_end_matches("mjy").trim_end_matches("jy");
    let stated =
        [("mhz", 1e6), ("ghz", 1e9)].into_iter().find_map(|(unit, hz)| Some((name.strip_suffix(unit)?, hz)));
    let (name, unit_hz) = stated.unwrap_or((name, 1e6));
    let (kind, digits) = name.split_at(name.find(|c: char| c.is_ascii_digit())?);
    let number: f64 = digits.parse().ok().filter(|_| digits.len() <= 6 && KINDS.contains(&kind))?;
    // Small or fractional numbers without a unit are in GHz, as in S1.4 and S5, or no frequencies.
    let is_frequency = stated.is_some() || (number >= 8.0 && !digits.contains('.'));
    (is_frequency && number > 0.0).then_some(number * unit_hz)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn columns(names: &str) -> Result<SourceColumns, String> {
        SourceColumns::recognise(&names.split(',').map(str::to_owned).collect::<Vec<_>>(), false)
    }

    #[test]
    fn published_names_are_known() {
        let nan = f64::NAN;
        for (names, frame, flux, hz, index) in [
            (
                "ecliptic_longitude_deg,ecliptic_latitude_deg,flux_154mhz_jy,flux_jy",
                Frame::Ecliptic,
                2,
                154e6,
                None,
            ),
            (
                "Name,RAJ2000,DEJ2000,Fpwide,Fintwide,Fp076,Fint076,alpha",
                Frame::Equatorial,
                4,
                200e6,
                Some(7),
            ),
            ("Name,RAJ2000,DEJ2000,Fpwide,Fintwide,Fp076,Fint076", Frame::Equatorial, 6, 76e6, None),
            ("int_flux_wide,int_flux_084,ra,dec", Frame::Equatorial, 1, 84e6, None),
            ("VLSSr,RAJ2000,DEJ2000,Sp,Si", Frame::Equatorial, 4, 73.8e6, None),
            ("name,ra,dec,flux_74_mhz", Frame::Equatorial, 3, 74e6, None),
            ("l,b,S408,spectral_index", Frame::Galactic, 2, 408e6, Some(3)),
            ("GLON,GLAT,flux_jy,frequency_mhz", Frame::Galactic, 2, nan, None),
            ("_RAJ2000,_DEJ2000,S1.4,S_12.6MHz", Frame::Equatorial, 3, 12.6e6, None),
            ("ra,dec,flux_1.4_ghz_mjy", Frame::Equatorial, 2, 1.4e9, None),
        ] {
            let found = columns(names).unwrap();
            let same_hz = found.flux_hz == hz || (hz.is_nan() && found.frequency_place == Some((3, 1e6)));
            assert!(same_hz, "{names}: {found:?}");
            assert_eq!((found.frame, found.flux, found.index), (frame, flux, index), "{names}");
        }
        let parts = columns("Name,RAh,RAm,RAs,DE-,DEd,DEm,DEs,S74").unwrap();
        assert_eq!(parts.places, [vec![1, 2, 3], vec![4, 5, 6, 7]]);
    }

    #[test]
    fn what_is_missing_is_named() {
        assert!(columns("a,b,flux_154mhz_jy").unwrap_err().contains("RAJ2000 and DEJ2000"));
        assert!(columns("RAB1950,DEB1950,S74").unwrap_err().contains("B1950"));
        for flux in ["flux", "S1.4", "S5", "Fp076", "e_Fint076"] {
            assert!(
                columns(&format!("ra,dec,{flux}")).unwrap_err().contains("names its frequency"),
                "{flux}"
            );
        }
        assert_eq!(
            SourceColumns::recognise(&["ra", "dec", "Si"].map(str::to_owned), true).unwrap().flux_hz,
            73.8e6
        );
    }
}
