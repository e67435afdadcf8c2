//! Writes the golden files of the formats into `schemas/golden/`.
//!
//! Run it only when a format gets a new version: `tests/golden.rs` holds the files fast.

#[path = "../tests/support/mod.rs"]
mod support;

use std::path::PathBuf;

use sightline_store::{
    BakeStore, Limits, Result, encode_cell_part, encode_object_part, encode_segment_part, publish,
};
use support::{Sample, segments};

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<()> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../schemas/golden");
    let open = |name: &str| BakeStore::open_or_create(&folder.join(name).to_string_lossy());
    let sample = Sample::golden();

    let dataset = open("dataset-v3")?;
    let manifest = sample.write(&dataset, Limits::default()).await;
    publish(&dataset, &manifest).await?;

    let parts = open("parts-v3")?;
    let cells = sample.all_rows();
    let pairs: Vec<_> = sample.cells.into_iter().flat_map(|(_, pairs)| pairs).collect();
    parts.put_pointer("segments.parquet", encode_segment_part(&segments(16))?).await?;
    parts.put_pointer("cells.parquet", encode_cell_part(&cells)?).await?;
    parts.put_pointer("objects.parquet", encode_object_part(&pairs)?).await
}
