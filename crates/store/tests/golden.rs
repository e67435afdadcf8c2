//! The golden files in `schemas/golden/`: formats are contracts.
//!
//! `cargo run --release -p sightline-store --example write_golden` writes them. A change of their
//! bytes is a change of the format, and takes a new version. One exception: an update of the zstd
//! library may compress to other bytes, and then only `writer_reproduces_golden_bytes` fails.

mod support;

use std::path::PathBuf;

use futures::TryStreamExt;
use sightline_store::{
    BakeStore, Dataset, Limits, Weight, decode_cell_part, decode_object_part, decode_segment_part,
    encode_cell_part, encode_object_part, encode_segment_part, publish,
};
use support::{Sample, segments};

fn golden(folder: &str) -> BakeStore {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../schemas/golden").join(folder);
    BakeStore::open(path.to_str().unwrap()).unwrap()
}

#[tokio::test]
async fn datasets_of_version_1_still_read() {
    let store = golden("dataset-v1");
    let report = Dataset::check(&store).await.unwrap();
    assert!(report.is_sound(), "{:?}", report.problems);
    let dataset = Dataset::open(&store).await.unwrap();
    assert_eq!(dataset.manifest().version, 1);
    for (row, pairs) in &Sample::golden_at_rest().cells {
        let old = dataset.cell(row.cell.id).await.unwrap();
        assert_eq!((&old.cell, old.tile, &old.set), (&row.cell, row.tile, &row.set));
        assert!(old.weights.iter().all(|w| *w == Weight::UNMEASURED));
        assert_eq!(old.weights.len() as u64, old.set.len());
        assert_eq!(old.effort.heldout_error_mean, row.effort.heldout_error_mean);
        assert_eq!((old.effort.heldout_error_upper, old.effort.target_met), (1.0, false));
        // The sample of version 1 had larger objects.
        let mut pairs = pairs.clone();
        pairs.iter_mut().for_each(|pair| pair.weight *= 64.0);
        assert_eq!(dataset.object_rows(row.cell.id).await.unwrap(), pairs);
    }
}

#[tokio::test]
async fn datasets_of_version_2_still_read() {
    let store = golden("dataset-v2");
    let report = Dataset::check(&store).await.unwrap();
    assert!(report.is_sound(), "{:?}", report.problems);
    let dataset = Dataset::open(&store).await.unwrap();
    assert_eq!((dataset.manifest().version, dataset.states()), (2, 1));
    let sample = Sample::golden_at_rest();
    let rows: Vec<_> = dataset.cell_rows().try_collect().await.unwrap();
    assert_eq!(rows, sample.all_rows());
    for (row, pairs) in &sample.cells {
        let id = row.cell.id;
        assert_eq!(&dataset.object_rows(id).await.unwrap(), pairs);
        assert_eq!(&dataset.cell_in_state(id, 0).await.unwrap(), row);
        assert_eq!(dataset.runs(id), [dataset.entry(id).unwrap().clone()]);
    }
    assert_eq!(dataset.objects().await.unwrap(), sample.objects);
    assert_eq!(dataset.numbering().await.unwrap(), sample.numbering);
}

#[tokio::test]
async fn golden_dataset_still_reads() {
    let store = golden("dataset-v3");
    let report = Dataset::check(&store).await.unwrap();
    assert!(report.is_sound(), "{:?}", report.problems);
    let dataset = Dataset::open(&store).await.unwrap();
    let sample = Sample::golden();
    assert_eq!(dataset.timeline(), &sample.timeline);
    let rows: Vec<_> = dataset.cell_rows().try_collect().await.unwrap();
    assert_eq!(rows, sample.all_rows());
    for (row, pairs) in &sample.cells {
        assert_eq!(&dataset.object_rows(row.cell.id).await.unwrap(), pairs);
    }
    assert_eq!(dataset.objects().await.unwrap(), sample.objects);
    assert_eq!(dataset.numbering().await.unwrap(), sample.numbering);
}

#[tokio::test]
async fn writer_reproduces_golden_bytes() {
    let store = BakeStore::in_memory();
    let manifest = Sample::golden().write(&store, Limits::default()).await;
    publish(&store, &manifest).await.unwrap();
    let golden = golden("dataset-v3");
    let keys = golden.list("").await.unwrap();
    assert_eq!(store.list("").await.unwrap(), keys);
    for key in keys {
        assert_eq!(store.get(&key).await.unwrap(), golden.get(&key).await.unwrap(), "{key}");
    }
}

#[tokio::test]
async fn golden_parts_still_read_and_are_reproduced() {
    let store = golden("parts-v3");
    let sample = Sample::golden();
    let cells = sample.all_rows();
    let pairs: Vec<_> = sample.cells.into_iter().flat_map(|(_, pairs)| pairs).collect();

    let bytes = store.get("segments.parquet").await.unwrap();
    assert_eq!(decode_segment_part("segments", bytes.clone()).unwrap(), segments(16));
    assert_eq!(encode_segment_part(&segments(16)).unwrap(), bytes);
    let bytes = store.get("cells.parquet").await.unwrap();
    assert_eq!(decode_cell_part("cells", bytes.clone()).unwrap(), cells);
    assert_eq!(encode_cell_part(&cells).unwrap(), bytes);
    let bytes = store.get("objects.parquet").await.unwrap();
    assert_eq!(decode_object_part("objects", bytes.clone()).unwrap(), pairs);
    assert_eq!(encode_object_part(&pairs).unwrap(), bytes);
}
