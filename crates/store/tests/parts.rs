//! Parts come back as they were written, give the same bytes every time, and refuse damage.

mod support;

use bytes::Bytes;
use proptest::prelude::*;
use sightline_geometry::SegmentId;
use sightline_store::{
    CellRow, ErrorClass, ObjectRow, decode_cell_part, decode_object_part, decode_segment_part,
    decode_segment_part_where, encode_cell_part, encode_object_part, encode_segment_part,
};
use support::{Sample, segments};

fn cells_and_pairs() -> (Vec<CellRow>, Vec<ObjectRow>) {
    let sample = Sample::golden();
    (sample.all_rows(), sample.cells.into_iter().flat_map(|(_, pairs)| pairs).collect())
}

#[test]
fn parts_come_back_as_they_were_written() {
    let rows = segments(200);
    let bytes = encode_segment_part(&rows).unwrap();
    assert_eq!(bytes, encode_segment_part(&rows).unwrap());
    assert_eq!(decode_segment_part("f", bytes.clone()).unwrap(), rows);
    let some = decode_segment_part_where("f", bytes, |s| s == SegmentId(9)).unwrap();
    // The first segment has two rows.
    assert_eq!(some, &rows[4..5]);
    assert_eq!(some[0].states(), 0..5);

    let (cells, pairs) = cells_and_pairs();
    let bytes = encode_cell_part(&cells).unwrap();
    assert_eq!(bytes, encode_cell_part(&cells).unwrap());
    assert_eq!(decode_cell_part("f", bytes).unwrap(), cells);
    let bytes = encode_object_part(&pairs).unwrap();
    assert_eq!(bytes, encode_object_part(&pairs).unwrap());
    assert_eq!(decode_object_part("f", bytes).unwrap(), pairs);
}

#[test]
fn empty_parts_are_parts() {
    assert!(decode_segment_part("f", encode_segment_part(&[]).unwrap()).unwrap().is_empty());
    assert!(decode_cell_part("f", encode_cell_part(&[]).unwrap()).unwrap().is_empty());
    assert!(decode_object_part("f", encode_object_part(&[]).unwrap()).unwrap().is_empty());
}

#[test]
fn rows_that_break_the_contract_are_refused() {
    let mut rows = segments(3);
    rows.swap(0, 1);
    assert_eq!(encode_segment_part(&rows).unwrap_err().class(), ErrorClass::FixInput);
    let mut rows = segments(3);
    rows[3].weights.push(0.5);
    let error = encode_segment_part(&rows).unwrap_err();
    assert!(error.to_string().contains("segment 6"), "{error}");
    let mut rows = segments(3);
    rows[1].last_state = 1;
    let error = encode_segment_part(&rows).unwrap_err();
    assert!(error.to_string().contains("states 2 to 1"), "{error}");
    let mut cells = cells_and_pairs().0;
    cells.swap(0, 1);
    let error = encode_cell_part(&cells).unwrap_err();
    assert!(error.to_string().contains("ascending"), "the row of all states is first: {error}");
}

#[test]
fn a_part_of_another_kind_is_refused_by_name() {
    let bytes = encode_cell_part(&cells_and_pairs().0).unwrap();
    let error = decode_segment_part("bake/x/parts/1.parquet", bytes).unwrap_err();
    assert_eq!(error.class(), ErrorClass::Corrupt);
    assert!(error.to_string().contains("bake/x/parts/1.parquet"), "{error}");
}

proptest! {
    #[test]
    fn damaged_parts_are_refused_or_read_but_never_panic(
        at in any::<prop::sample::Index>(), flip in 1..=255_u8, cut in any::<bool>(),
    ) {
        let mut bytes = encode_segment_part(&segments(20)).unwrap().to_vec();
        let at = at.index(bytes.len());
        if cut { bytes.truncate(at) } else { bytes[at] ^= flip }
        if let Err(error) = decode_segment_part("part", Bytes::from(bytes)) {
            prop_assert!(error.to_string().contains("part"));
        }
    }
}
