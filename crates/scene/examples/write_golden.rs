//! Writes the golden particle tables into a folder: `schemas/golden/particles-v1` when none is given.

#![allow(clippy::print_stdout)]

use std::error::Error;
use std::path::PathBuf;

#[path = "../tests/fixtures/golden.rs"]
mod golden;

fn main() -> Result<(), Box<dyn Error>> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../schemas/golden/particles-v1");
    let folder = std::env::args().nth(1).map_or_else(|| PathBuf::from(default), PathBuf::from);
    std::fs::create_dir_all(&folder)?;
    for (name, format) in golden::TABLES {
        let path = folder.join(name);
        std::fs::write(&path, golden::bytes(format)?)?;
        println!("{}", path.display());
    }
    Ok(())
}
