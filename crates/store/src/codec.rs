//! A set of primitives as bytes: varint (gap, length) runs.
//!
//! For each run `first .. end` in ascending order, two unsigned LEB128 numbers of at most 32 bits:
//! the gap from the end of the run before (from 0, for the first run), then the length. There is
//! no header; the empty set is no bytes. The encoding is canonical: gaps behind the first run and
//! all lengths are at least 1, and no number has superfluous zero groups, so one set has exactly
//! one encoding and [`decode_set`] accepts nothing else.
//!
//! Worked example and rationale: `schemas/set-encoding-v1.md`.

use sightline_geometry::{PrimitiveSet, Run};

/// A varint of 32 bits has at most five groups of seven bits.
const VARINT_BYTES_MAX: usize = 5;

/// Why bytes are not an encoded set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// The bytes end within a run.
    #[error("the encoded set ends within a run")]
    Truncated,
    /// A number has more than 32 bits, or superfluous zero groups.
    #[error("byte {at} of the encoded set starts no canonical 32-bit varint")]
    BadVarint {
        /// Offset of the number's first byte.
        at: usize,
    },
    /// A run is empty, touches the run before, or ends behind the last primitive number.
    #[error("the run at byte {at} of the encoded set is empty, touches its neighbour or overflows")]
    BadRun {
        /// Offset of the run's first byte.
        at: usize,
    },
}

/// Encodes a set.
#[must_use]
pub fn encode_set(set: &PrimitiveSet) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(3 * set.runs().len());
    let mut end = 0;
    for run in set.runs() {
        put_varint(&mut bytes, run.first - end);
        put_varint(&mut bytes, run.end - run.first);
        end = run.end;
    }
    bytes
}

/// Decodes a set. Memory is proportional to the bytes, whatever they are.
///
/// # Errors
/// [`DecodeError`] for every input that [`encode_set`] does not produce.
pub fn decode_set(bytes: &[u8]) -> Result<PrimitiveSet, DecodeError> {
    let mut set = PrimitiveSet::default();
    let (mut at, mut end) = (0, 0_u32);
    while at < bytes.len() {
        let start = at;
        let gap = take_varint(bytes, &mut at)?;
        let length = take_varint(bytes, &mut at)?;
        let first = end.checked_add(gap);
        let run_end = first.and_then(|first| first.checked_add(length));
        let (Some(first), Some(run_end)) = (first, run_end) else {
            return Err(DecodeError::BadRun { at: start });
        };
        if length == 0 || (gap == 0 && start > 0) {
            return Err(DecodeError::BadRun { at: start });
        }
        set.push(Run { first, end: run_end });
        end = run_end;
    }
    Ok(set)
}

fn put_varint(bytes: &mut Vec<u8>, mut value: u32) {
    while value >= 0x80 {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
}

fn take_varint(bytes: &[u8], at: &mut usize) -> Result<u32, DecodeError> {
    let start = *at;
    let mut value = 0_u64;
    for group in 0..VARINT_BYTES_MAX {
        let byte = *bytes.get(start + group).ok_or(DecodeError::Truncated)?;
        value |= u64::from(byte & 0x7f) << (7 * group);
        if byte & 0x80 == 0 {
            *at = start + group + 1;
            let superfluous = group > 0 && byte == 0;
            return match u32::try_from(value) {
                Ok(value) if !superfluous => Ok(value),
                _ => Err(DecodeError::BadVarint { at: start }),
            };
        }
    }
    Err(DecodeError::BadVarint { at: start })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Runs from (gap, length) pairs, as far as they fit into 32 bits.
    fn set_of(pairs: &[(u32, u32)]) -> PrimitiveSet {
        let mut set = PrimitiveSet::default();
        let mut end = 0_u32;
        for &(gap, length) in pairs {
            let Some(first) = end.checked_add(gap) else { break };
            let Some(run_end) = first.checked_add(length) else { break };
            set.push(Run { first, end: run_end });
            end = run_end;
        }
        set
    }

    #[test]
    fn the_example_of_the_schema_page_holds() {
        let set = PrimitiveSet::from_sorted((3..6).chain(300..301));
        assert_eq!(encode_set(&set), [0x03, 0x03, 0xa6, 0x02, 0x01]);
    }

    #[test]
    fn the_empty_set_is_no_bytes() {
        assert!(encode_set(&PrimitiveSet::default()).is_empty());
        assert_eq!(decode_set(&[]), Ok(PrimitiveSet::default()));
    }

    #[test]
    fn the_whole_range_is_one_run() {
        let set = set_of(&[(0, u32::MAX)]);
        assert_eq!(decode_set(&encode_set(&set)), Ok(set));
    }

    #[test]
    fn every_rule_of_the_encoding_is_enforced() {
        use DecodeError::*;
        assert_eq!(decode_set(&[5]), Err(Truncated));
        assert_eq!(decode_set(&[0x80]), Err(Truncated));
        assert_eq!(decode_set(&[0x80, 0x00, 1]), Err(BadVarint { at: 0 }));
        assert_eq!(decode_set(&[1, 0xff, 0xff, 0xff, 0xff, 0x1f]), Err(BadVarint { at: 1 }));
        assert_eq!(decode_set(&[0xff; 8]), Err(BadVarint { at: 0 }));
        assert_eq!(decode_set(&[1, 0]), Err(BadRun { at: 0 }));
        assert_eq!(decode_set(&[1, 1, 0, 1]), Err(BadRun { at: 2 }));
        assert_eq!(
            decode_set(&[1, 0xff, 0xff, 0xff, 0xff, 0x0f]),
            Err(BadRun { at: 0 }),
            "a run may not end behind the last number"
        );
    }

    proptest! {
        #[test]
        fn sets_survive_the_round_trip(
            pairs in prop::collection::vec((1..100_000_u32, 1..3000_u32), 0..300),
        ) {
            let set = set_of(&pairs);
            let decoded = decode_set(&encode_set(&set)).unwrap();
            decoded.assert_well_formed();
            prop_assert_eq!(decoded, set);
        }

        #[test]
        fn garbage_is_refused_or_is_the_encoding_of_what_it_decodes_to(
            bytes in prop::collection::vec(any::<u8>(), 0..64),
        ) {
            if let Ok(set) = decode_set(&bytes) {
                set.assert_well_formed();
                prop_assert_eq!(encode_set(&set), bytes);
            }
        }
    }
}
