//! `sightline export`: what one cell sees, as glTF.

use std::path::Path;

use serde_json::json;
use sightline_scene::Scene;
use sightline_scene::export::{ExportReport, export_visible};
use sightline_store::CellRow;

use super::dataset::open_with_scene;
use crate::arguments::Export;
use crate::failure::Result;
use crate::progress::note;
use crate::report::{Table, bytes, count, print, print_json, thousands};

pub fn run(command: &Export) -> Result<()> {
    let runtime = super::runtime()?;
    let (dataset, scene, path) = runtime.block_on(open_with_scene(&command.input))?;
    super::expect_cell(&dataset, command.cell)?;
    let mut row = runtime.block_on(dataset.cell(command.cell))?;
    if let Some(budget) = command.budget {
        row.set = row.most_important(usize::try_from(budget).unwrap_or(usize::MAX));
    }
    let report = write(&path, &scene, &row, &command.out)?;
    if command.json {
        print_json(&json!({
            "dataset": command.input.dataset,
            "cell": command.cell,
            "out": command.out,
            "triangles": report.triangles,
            "particles": report.particles,
            "unique_triangles": report.unique_triangles,
            "nodes": report.nodes,
            "meshes": report.meshes,
            "materials": report.materials,
            "images": report.images,
            "bytes": report.bytes,
            "warnings": report.warnings,
        }));
    } else {
        print(&to_text(&report, &row, &scene, &command.out));
    }
    Ok(())
}

/// Exports the set of a cell.
pub fn write(source: &Path, scene: &Scene, row: &CellRow, out: &Path) -> Result<ExportReport> {
    let report = export_visible(source, scene, &row.set, out)?;
    for warning in &report.warnings {
        note(&format!("warning: {warning}"));
    }
    Ok(report)
}

/// What was exported, for people.
pub fn to_text(report: &ExportReport, row: &CellRow, scene: &Scene, out: &Path) -> String {
    let all = thousands(u64::from(scene.geometry.primitive_count()));
    let mut table = Table::default();
    table
        .row("cell", row.cell.id.to_string())
        .row("file", format!("{}, {}", out.display(), bytes(report.bytes)))
        .row("triangles", format!("{} of {all}", thousands(report.triangles)))
        .row("nodes", thousands(report.nodes as u64))
        .row("meshes", thousands(report.meshes as u64))
        .row(
            "materials",
            format!(
                "{}, {}",
                thousands(report.materials as u64),
                count(report.images as u64, "image")
            ),
        );
    table.to_string()
}
