//! The visibility dataset: Parquet layout, manifest, commits, reader.
