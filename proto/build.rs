//! Compiles the protocol without protoc, and keeps its descriptors for gRPC reflection.

use std::{env, error::Error, fs, path::Path};

use prost::Message;

fn main() -> Result<(), Box<dyn Error>> {
    let files = [
        "sightline/v1/plan.proto",
        "sightline/v1/coordinator.proto",
        "sightline/v1/reuse.proto",
        "keda/externalscaler.proto",
    ];
    let descriptors = protox::compile(files, ["."])?;
    let out = env::var_os("OUT_DIR").ok_or("cargo sets OUT_DIR")?;
    fs::write(Path::new(&out).join("descriptors.bin"), descriptors.encode_to_vec())?;
    for file in files {
        println!("cargo:rerun-if-changed={file}");
    }
    // A map with a fixed order makes the encoded plan a function of the plan.
    tonic_prost_build::configure().btree_map(".").compile_fds(descriptors)?;
    Ok(())
}
