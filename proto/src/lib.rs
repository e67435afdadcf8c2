//! The cluster protocol: generated gRPC code, and conversions from and to [`sightline_jobs`].
//!
//! Promise: what converts without an error is well formed. Messages come from other processes
//! and stored files, so a missing or impossible field is a [`ConvertError`], never a panic.

pub mod access;
mod convert;

pub use convert::{ConvertError, decode_plan, encode_plan};

/// Generated from `sightline/v1/*.proto`.
#[allow(missing_docs, clippy::pedantic)]
pub mod v1 {
    tonic::include_proto!("sightline.v1");

    /// Descriptors of all messages and services, for gRPC reflection.
    pub const FILE_DESCRIPTOR_SET: &[u8] =
        include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
}

/// Generated from `keda/externalscaler.proto`: what KEDA asks to know how many workers to run.
#[allow(missing_docs, clippy::pedantic)]
pub mod keda {
    tonic::include_proto!("externalscaler");
}

/// Largest message that either side of the protocol accepts, bytes. The largest are statuses, whose
/// lists are bounded: a quarantined task comes with a reason of several kB at most.
pub const MESSAGE_BYTES_MAX: usize = 4 << 20;
