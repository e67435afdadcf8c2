//! The URIs of buffers: data URIs (RFC 2397) and files in the folder of the scene.
//!
//! Promise: a URI never names a file outside the folder of the main file, by its text. Schemes,
//! absolute paths, drive letters and `..` are refused; percent encoding is undone first.

use base64::{
    Engine, alphabet,
    engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig},
};

use crate::UriProblem;

/// What a URI stands for.
#[derive(Debug, PartialEq, Eq)]
pub enum Target {
    /// The bytes of a data URI.
    Data(Vec<u8>),
    /// A path relative to the folder of the main file, `/` between its parts.
    File(String),
}

/// Base64 with or without padding, as exporters write both.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &alphabet::STANDARD,
    GeneralPurposeConfig::new()
        .with_decode_padding_mode(DecodePaddingMode::Indifferent)
        .with_decode_allow_trailing_bits(true),
);

/// Reads a URI.
pub fn resolve(uri: &str) -> Result<Target, UriProblem> {
    if uri.get(..5).is_some_and(|s| s.eq_ignore_ascii_case("data:")) {
        return data(&uri[5..]).map(Target::Data);
    }
    if uri.is_empty() {
        return Err(UriProblem::Empty);
    }
    if let Some((scheme, _)) = uri.split_once(':')
        && scheme.starts_with(|c: char| c.is_ascii_alphabetic())
        && scheme.chars().all(|c| c.is_ascii_alphanumeric() || "+-.".contains(c))
    {
        // One letter is a drive of Windows.
        let drive = scheme.len() == 1;
        return Err(if drive { UriProblem::Absolute } else { UriProblem::Scheme });
    }
    let path = String::from_utf8(percent_decode(uri)?).map_err(|_| UriProblem::Encoding)?;
    if path.contains('\0') {
        return Err(UriProblem::Encoding);
    }
    let separators = ['/', '\\'];
    let drive = path.as_bytes().get(1) == Some(&b':') && path.as_bytes()[0].is_ascii_alphabetic();
    if path.starts_with(separators) || drive {
        return Err(UriProblem::Absolute);
    }
    if path.split(separators).any(|part| part == "..") {
        return Err(UriProblem::Escape);
    }
    Ok(Target::File(path))
}

/// The bytes of a data URI, given without `data:`.
fn data(rest: &str) -> Result<Vec<u8>, UriProblem> {
    let (kind, payload) = rest.split_once(',').ok_or(UriProblem::Data)?;
    if kind.to_ascii_lowercase().ends_with(";base64") {
        BASE64.decode(payload).map_err(|_| UriProblem::Data)
    } else {
        percent_decode(payload).map_err(|_| UriProblem::Data)
    }
}

fn percent_decode(text: &str) -> Result<Vec<u8>, UriProblem> {
    let mut out = Vec::with_capacity(text.len());
    let mut bytes = text.bytes();
    while let Some(b) = bytes.next() {
        if b != b'%' {
            out.push(b);
            continue;
        }
        let mut digit = || bytes.next().and_then(|d| (d as char).to_digit(16));
        match (digit(), digit()) {
            (Some(high), Some(low)) => out.push((high * 16 + low) as u8),
            _ => return Err(UriProblem::Encoding),
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_stay_in_the_folder_of_the_scene() {
        let file = |s: &str| Ok(Target::File(s.into()));
        assert_eq!(resolve("a%20b/c.bin"), file("a b/c.bin"));
        assert_eq!(resolve("a..b.bin"), file("a..b.bin"));
        for uri in ["../a", "a/../../b", "%2e%2e/a", "a\\..\\b", "a/.."] {
            assert_eq!(resolve(uri), Err(UriProblem::Escape), "{uri}");
        }
        for uri in ["/etc/passwd", "%2Fetc/passwd", "\\\\host\\a", "C:\\a", "c:/a", "c%3A/a"] {
            assert_eq!(resolve(uri), Err(UriProblem::Absolute), "{uri}");
        }
        for uri in ["http://x/a.bin", "file:///a", "ftp:a"] {
            assert_eq!(resolve(uri), Err(UriProblem::Scheme), "{uri}");
        }
        for uri in ["a%2", "a%zz", "%ff", "a%00b"] {
            assert_eq!(resolve(uri), Err(UriProblem::Encoding), "{uri}");
        }
        assert_eq!(resolve(""), Err(UriProblem::Empty));
    }

    #[test]
    fn data_uris_decode_with_and_without_padding() {
        for uri in ["data:;base64,AQI=", "data:application/octet-stream;base64,AQI", "DATA:,%01%02"]
        {
            assert_eq!(resolve(uri), Ok(Target::Data(vec![1, 2])), "{uri}");
        }
        for uri in ["data:", "data:;base64,A", "data:;base64,!!!!"] {
            assert_eq!(resolve(uri), Err(UriProblem::Data), "{uri}");
        }
    }
}
