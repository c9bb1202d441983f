//! What files are, by their first bytes.

/// Place of a signature in a file, the signature, the name of the form, and what makes such a file readable.
type Form = (usize, &'static [u8], &'static str, &'static str);

/// Forms that are neither plain text nor a downlink.
const FORMS: [Form; 21] = [
    (0, b"\x1f\x8b", "a gzip file", "expand it first (gunzip)"),
    (0, b"\x28\xb5\x2f\xfd", "a zstd file", "expand it first (unzstd)"),
    (0, b"\xfd7zXZ", "an xz file", "expand it first (unxz)"),
    (0, b"BZh", "a bzip2 file", "expand it first (bunzip2)"),
    (0, b"\x04\x22\x4d\x18", "an lz4 file", "expand it first (unlz4)"),
    (0, b"PK\x03\x04", "a zip file", "expand it first (unzip)"),
    (0, b"7z\xbc\xaf\x27\x1c", "a 7z file", "expand it first"),
    (257, b"ustar", "a tar archive", "unpack it first (tar -x)"),
    (0, b"\xff\xfe", "text in UTF-16", ""),
    (0, b"\xfe\xff", "text in UTF-16", ""),
    (
        0,
        b"\x89HDF",
        "an HDF5 file (as UVH5 is)",
        "lunarray.from_uvdata of the Python package makes a downlink of visibilities",
    ),
    (0, b"CDF\x01", "a netCDF file", ""),
    (0, b"CDF\x02", "a netCDF file", ""),
    (0, b"SIMPLE  =", "a FITS file", ""),
    (
        0,
        b"PAR1",
        "a Parquet file",
        "lunarray.from_table of the Python package makes a downlink of visibilities",
    ),
    (0, b"\x93NUMPY", "a numpy array", ""),
    (0, b"\x89PNG", "a PNG picture", ""),
    (0, b"%PDF", "a PDF file", ""),
    (
        0,
        b"LNRSTA",
        "a checkpoint of a lunarray state",
        "give the folder of the state to a command that takes states",
    ),
    (0, b"\xd4\xc3\xb2\xa1", "a network capture (pcap)", ""),
    (0, b"\x0a\x0d\x0d\x0a", "a network capture (pcapng)", ""),
];

fn signed(bytes: &[u8]) -> Option<&'static Form> {
    FORMS.iter().find(|(at, signature, ..)| bytes.get(*at..).is_some_and(|rest| rest.starts_with(signature)))
}

/// Names the form of a file of which these are the first bytes or all; `None` if it may be plain text.
#[must_use]
pub fn form_of(bytes: &[u8]) -> Option<&'static str> {
    // Latin letters in UTF-16 have a zero in every second byte.
    let is_wide = bytes.first_chunk::<4>().is_some_and(|four| {
        matches!(four.map(|byte| byte == 0), [true, false, true, false] | [false, true, false, true])
    });
    signed(bytes).map(|(_, _, name, _)| *name).or(is_wide.then_some("text in UTF-16"))
}

/// Names the form of a file by its signature, and says what makes such a file readable.
#[must_use]
pub fn form_with_remedy(bytes: &[u8]) -> Option<String> {
    signed(bytes).map(|(_, _, name, remedy)| match *remedy {
        "" => (*name).to_owned(),
        remedy => format!("{name}: {remedy}"),
    })
}

/// The text of a file: without a byte order mark, with line ends `\n`, and with bytes replaced that are no UTF-8, as in names in other
/// encodings. The error names the form of a file that is no plain text.
///
/// # Errors
/// The form of the file.
pub fn text_of(bytes: &[u8]) -> Result<String, &'static str> {
    if let Some(form) = form_of(bytes) {
        return Err(form);
    }
    let text = String::from_utf8_lossy(bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes));
    Ok(if text.contains('\n') { text.into_owned() } else { text.replace('\r', "\n") })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_read_and_other_forms_are_named() {
        for (bytes, text) in [
            (&b"a,b\n1,2\n"[..], "a,b\n1,2\n"),
            (b"\xef\xbb\xbfa\r1", "a\n1"),
            (b"# caf\xe9\n", "# caf\u{fffd}\n"),
            (b"", ""),
        ] {
            assert_eq!(text_of(bytes).as_deref(), Ok(text));
        }
        for (bytes, name) in [
            (&b"\x28\xb5\x2f\xfd\x00"[..], "zstd"),
            (b"PK\x03\x04\x14", "zip"),
            (b"a\0,\0b\0", "UTF-16"),
            (b"\0a\0,", "UTF-16"),
        ] {
            assert!(text_of(bytes).unwrap_err().contains(name), "{name}");
        }
        let tar = [&b"s.ccsds"[..], &[0; 250], b"ustar  \0"].concat();
        assert_eq!(text_of(&tar), Err("a tar archive"));
    }
}
