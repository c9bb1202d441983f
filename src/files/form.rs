//! What files are, by their first bytes.

/// First bytes of forms that are no plain text.
const SIGNATURES: [(&[u8], &str); 10] = [
    (b"\x1f\x8b", "a gzip file"),
    (b"\x28\xb5\x2f\xfd", "a zstd file"),
    (b"\xfd7zXZ", "an xz file"),
    (b"PK\x03\x04", "a zip file"),
    (b"\xff\xfe", "text in UTF-16"),
    (b"\xfe\xff", "text in UTF-16"),
    (b"SIMPLE  =", "a FITS file"),
    (b"\x89HDF", "an HDF5 file"),
    (b"PAR1", "a Parquet file"),
    (b"%PDF", "a PDF file"),
];

/// Names the form of a file of which these are the first bytes or all; `None` if it may be plain text.
#[must_use]
pub fn form_of(bytes: &[u8]) -> Option<&'static str> {
    // Latin letters in UTF-16 have a zero in every second byte.
    let is_wide = bytes.first_chunk::<4>().is_some_and(|four| {
        matches!(four.map(|byte| byte == 0), [true, false, true, false] | [false, true, false, true])
    });
    let signed = SIGNATURES.iter().find(|(signature, _)| bytes.starts_with(signature));
    signed.map(|(_, name)| *name).or(is_wide.then_some("text in UTF-16"))
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
    }
}
