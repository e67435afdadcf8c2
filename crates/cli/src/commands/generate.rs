//! `sightline generate`: a benchmark scene as glTF.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use serde_json::json;
use sightline_scene::generate::{self, GenerateReport, Kind as Generated};

use crate::arguments::{Generate, SceneKind};
use crate::failure::{Failure, Kind, Result};
use crate::memory::Phases;
use crate::report::{Table, bytes, print, print_json, thousands};

pub fn run(command: &Generate) -> Result<()> {
    let kind = match command.kind {
        SceneKind::City => Generated::City,
        SceneKind::Town => Generated::Town,
        SceneKind::Grass => Generated::Grass,
    };
    let mut phases = Phases::start("generate");
    let made = write(kind, command.triangles, command.seed, &command.out)?;
    phases.finish();
    let region = flag_value(&made.suggested_region);
    let eyes = flag_value(&made.suggested_eye_height);
    if command.json {
        print_json(&json!({
            "scene": command.out,
            "kind": kind.name(),
            "seed": command.seed,
            "triangles": made.triangles,
            "unique_triangles": made.unique_triangles,
            "bytes": made.bytes,
            "bounds": { "min": made.bounds.min, "max": made.bounds.max },
            "suggested_region": made.suggested_region,
            "suggested_eye_height": made.suggested_eye_height,
            "time": phases.to_json(),
        }));
        return Ok(());
    }
    let mut table = Table::default();
    table
        .row("scene", command.out.display().to_string())
        .row("triangles", thousands(made.triangles))
        .row("unique triangles", thousands(made.unique_triangles))
        .row("size", bytes(made.bytes));
    phases.add_to(&mut table);
    print(&format!(
        "{table}\nTo bake it:\n  sightline bake {} --out visible --region={region} --eye-height {eyes}\n",
        super::quoted(&command.out.display().to_string()),
    ));
    Ok(())
}

/// Generates a scene into a file, which appears when it is complete.
pub fn write(kind: Generated, triangles: u64, seed: u64, out: &Path) -> Result<GenerateReport> {
    let failed = |what, path: &Path, e: &std::io::Error| {
        Failure::io(Kind::Store, what, path, e)
            .with_help("check that the folder exists, its rights and its free space")
    };
    super::write_whole(out, |partial| {
        let file = File::create(partial).map_err(|e| failed("write", partial, &e))?;
        let mut file = BufWriter::new(file);
        let report = generate::generate(kind, triangles, seed, &mut file)?;
        let file = file.into_inner().map_err(|e| failed("write", partial, e.error()))?;
        file.sync_all().map_err(|e| failed("write", partial, &e))?;
        Ok(report)
    })
}

/// Numbers as a flag takes them.
fn flag_value(numbers: &[f64]) -> String {
    let numbers: Vec<String> = numbers.iter().map(f64::to_string).collect();
    numbers.join(",")
}
