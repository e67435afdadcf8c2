//! Sizes of memory as people write them: `4GiB`, `800MiB`, `2_000_000`.

use std::{fmt, str::FromStr};

/// A number of bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ByteSize(pub u64);

/// A text that is no size.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no size: give a number and a unit, such as 4GiB, 800MiB or 1.5GB")]
pub struct SizeError(String);

const UNITS: [(&str, f64); 12] = [
    ("kib", 1024.0),
    ("mib", 1_048_576.0),
    ("gib", 1_073_741_824.0),
    ("tib", 1_099_511_627_776.0),
    ("ki", 1024.0),
    ("mi", 1_048_576.0),
    ("gi", 1_073_741_824.0),
    ("kb", 1e3),
    ("mb", 1e6),
    ("gb", 1e9),
    ("tb", 1e12),
    ("b", 1.0),
];

impl FromStr for ByteSize {
    type Err = SizeError;

    fn from_str(text: &str) -> Result<Self, SizeError> {
        let error = || SizeError(text.to_owned());
        let lower = text.trim().to_lowercase();
        let (number, factor) = UNITS
            .iter()
            .find_map(|(unit, factor)| Some((lower.strip_suffix(unit)?, *factor)))
            .unwrap_or((&lower, 1.0));
        let number = number.trim().replace('_', "");
        if !number.starts_with(|c: char| c.is_ascii_digit()) {
            return Err(error());
        }
        let bytes = number.parse::<f64>().map_err(|_| error())? * factor;
        // 2^53 bytes are more than any machine has; up to there, no byte is lost.
        if bytes.is_finite() && (1.0..9e15).contains(&bytes) {
            Ok(Self(bytes as u64))
        } else {
            Err(error())
        }
    }
}

impl fmt::Display for ByteSize {
    /// With the largest unit of 1024 that leaves at least 1.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = ["bytes", "KiB", "MiB", "GiB", "TiB"];
        let mut value = self.0 as f64;
        let mut unit = 0;
        while value >= 1024.0 && unit + 1 < names.len() {
            value /= 1024.0;
            unit += 1;
        }
        if value.fract() == 0.0 {
            write!(f, "{value:.0} {}", names[unit])
        } else {
            write!(f, "{value:.1} {}", names[unit])
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_as_people_write_them() {
        let bytes = |text: &str| text.parse::<ByteSize>().map(|s| s.0).ok();
        assert_eq!(bytes("1GiB"), Some(1 << 30));
        assert_eq!(bytes("800 MiB"), Some(800 << 20));
        assert_eq!(bytes("4Gi"), Some(4 << 30));
        assert_eq!(bytes("1.5gb"), Some(1_500_000_000));
        assert_eq!(bytes("2_000"), Some(2000));
        assert_eq!(bytes("64KiB"), Some(65_536));
        for wrong in ["", "GiB", "-1GiB", "0", "1 XiB", "inf", "nan", "1e300GiB", "one", ".5GiB"] {
            assert_eq!(bytes(wrong), None, "{wrong}");
        }
        let message = "4 XiB".parse::<ByteSize>().unwrap_err().to_string();
        assert!(message.contains("`4 XiB`") && message.contains("800MiB"), "{message}");
    }

    #[test]
    fn sizes_are_written_with_a_unit() {
        let text = |bytes: u64| ByteSize(bytes).to_string();
        assert_eq!(text(1 << 30), "1 GiB");
        assert_eq!(text(1000), "1000 bytes");
        assert_eq!(text((3 << 20) / 2), "1.5 MiB");
    }
}
