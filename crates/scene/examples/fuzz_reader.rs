//! A long fuzzing campaign of the glTF reader on stable Rust.
//!
//! `fuzz_reader --seconds N --seed S [FOLDER]` mutates every glTF file below FOLDER (default:
//! `SIGHTLINE_SCENES`) and reads it. A panic, a read of more than 5 s, a scene that is not well
//! formed, or a peak of memory of more than 1 GiB ends the campaign with an error and leaves the
//! input in the temporary folder.

#![allow(clippy::print_stdout, missing_docs)]

#[path = "../tests/fixtures/mutate.rs"]
#[allow(dead_code)]
mod mutate;

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use mutate::{Rng, mutate};
use sightline_scene::{OpenOptions, Scene};

const SLOWEST: Duration = Duration::from_secs(5);
const LARGEST_KIB: u64 = 1 << 20;
/// Larger files are left to the corpus test: a campaign wants many inputs.
const LARGEST_SEED: u64 = 600 << 10;

fn main() -> Result<(), String> {
    let mut arguments = std::env::args().skip(1);
    let (mut seconds, mut seed) = (60, 1);
    let mut folder = std::env::var_os("SIGHTLINE_SCENES").map(PathBuf::from);
    while let Some(argument) = arguments.next() {
        let mut number = || -> Result<u64, String> {
            let value = arguments.next().ok_or("a number is missing")?;
            value.parse().map_err(|e| format!("{value}: {e}"))
        };
        match argument.as_str() {
            "--seconds" => seconds = number()?,
            "--seed" => seed = number()?,
            _ => folder = Some(argument.into()),
        }
    }
    let folder = folder.ok_or("give a folder of glTF files, or set SIGHTLINE_SCENES")?;
    let seeds = load(&folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    if seeds.is_empty() {
        return Err("no glTF files".into());
    }
    println!("{} seed files", seeds.len());
    campaign(&seeds, Duration::from_secs(seconds), seed)
}

fn load(folder: &Path) -> std::io::Result<Vec<(PathBuf, Vec<u8>)>> {
    let mut seeds = Vec::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder)? {
            let path = entry?.path();
            let is_gltf = path.extension().is_some_and(|e| e == "gltf" || e == "glb");
            if path.is_dir() {
                folders.push(path);
            } else if is_gltf && path.metadata()?.len() <= LARGEST_SEED {
                let content = std::fs::read(&path)?;
                seeds.push((path, content));
            }
        }
    }
    seeds.sort();
    Ok(seeds)
}

fn campaign(seeds: &[(PathBuf, Vec<u8>)], time: Duration, seed: u64) -> Result<(), String> {
    let start = Instant::now();
    let mut rng = Rng(seed);
    let (mut inputs, mut read, mut slowest) = (0u64, 0u64, Duration::ZERO);
    while start.elapsed() < time {
        let (path, content) = &seeds[rng.below(seeds.len())];
        let main = mutate(content, &mut rng);
        let keep = |what: &str| {
            let kept = std::env::temp_dir().join("fuzz_reader_input");
            let kept_at = std::fs::write(&kept, &main).map(|()| kept.display().to_string());
            format!("{what}: a mutation of {} in {kept_at:?}", path.display())
        };
        let began = Instant::now();
        let outcome = std::panic::catch_unwind(|| {
            Scene::open_bytes(path, &main, &OpenOptions::default())
                .map(|scene| scene.assert_well_formed())
                .is_ok()
        });
        let took = began.elapsed();
        slowest = slowest.max(took);
        inputs += 1;
        read += u64::from(outcome.map_err(|_| keep("panic"))?);
        if took > SLOWEST {
            return Err(keep("slow"));
        }
        if peak_kib() > LARGEST_KIB {
            return Err(keep("memory"));
        }
    }
    println!(
        "{inputs} inputs in {:.0} s, {read} read, {} refused; slowest {:.3} s; peak {} MiB",
        start.elapsed().as_secs_f64(),
        inputs - read,
        slowest.as_secs_f64(),
        peak_kib() / 1024,
    );
    Ok(())
}

/// Peak resident memory of this process; 0 where the system does not say.
fn peak_kib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.split_whitespace().next()?.parse().ok()).unwrap_or(0)
}
