//! Writes the golden particle tables and the golden chunk file with its scene into folders of
//! `schemas/golden`, or of the one that is given.

#![allow(clippy::print_stdout)]

use std::error::Error;
use std::path::PathBuf;

#[path = "../tests/fixtures/mod.rs"]
mod fixtures;

use fixtures::golden;
use sightline_scene::{MemoryLimit, OpenOptions, Scene};

fn main() -> Result<(), Box<dyn Error>> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../schemas/golden");
    let folder = std::env::args().nth(1).map_or_else(|| PathBuf::from(default), PathBuf::from);
    let (tables, chunks) = (folder.join("particles-v1"), folder.join("chunks-v1"));
    std::fs::create_dir_all(&tables)?;
    std::fs::create_dir_all(&chunks)?;
    for (name, format) in golden::TABLES {
        let path = tables.join(name);
        std::fs::write(&path, golden::bytes(format)?)?;
        println!("{}", path.display());
    }
    let scene = chunks.join("scene.glb");
    std::fs::write(&scene, fixtures::odds_and_ends().glb())?;
    let mut options = OpenOptions::default();
    options.memory = Some(MemoryLimit::new(1 << 40, chunks.clone()));
    let _ = Scene::open(&scene, &options)?;
    println!("{}", scene.display());
    Ok(())
}
