//! `sightline export`: what one cell sees, as glTF.

use std::path::Path;

use serde_json::json;
use sightline_geometry::Moment;
use sightline_scene::Scene;
use sightline_scene::export::{ExportOptions, ExportReport, export_visible_with};
use sightline_store::{CellRow, Dataset, redacted};

use super::dataset::open_with_scene;
use crate::arguments::Export;
use crate::failure::{Failure, Kind, Result};
use crate::progress::note;
use crate::report::{Table, bytes, count, print, print_json, thousands};

pub fn run(command: &Export) -> Result<()> {
    let runtime = super::runtime()?;
    let (dataset, scene, found) = runtime.block_on(open_with_scene(&command.input))?;
    super::expect_cell(&dataset, command.cell)?;
    let moment = moment(command, &dataset, &scene)?;
    let mut row = runtime.block_on(async {
        match moment {
            Some(moment) => dataset.cell_in_state(command.cell, moment.state).await,
            None => dataset.cell(command.cell).await,
        }
    })?;
    if let Some(budget) = command.budget {
        row.set = row.most_important(usize::try_from(budget).unwrap_or(usize::MAX));
    }
    let report = write(&found.path, &scene, &row, moment, &command.out)?;
    if command.json {
        print_json(&json!({
            "dataset": redacted(&command.input.dataset),
            "cell": command.cell,
            "state": moment.map(|m| m.state),
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

/// The moment that was asked for.
fn moment(command: &Export, dataset: &Dataset, scene: &Scene) -> Result<Option<Moment>> {
    let states = dataset.states();
    let none = |what: String| {
        let times = &scene.key_times;
        let (first, last) = (times[0], times[times.len() - 1]);
        Failure::new(Kind::Usage, format!("the dataset has no {what}"))
            .with_help(format!("it has states 0 to {}, from {first} to {last} seconds", states - 1))
    };
    match (command.state, command.time) {
        (Some(state), _) if state >= states => Err(none(format!("state {state}"))),
        (Some(state), _) => Ok(Some(Moment { state, t: 0.0 })),
        (None, Some(time)) if !time.is_finite() => Err(none(format!("time {time}"))),
        (None, time) => Ok(time.map(|time| scene.moment_at(time))),
    }
}

/// Exports the set of a cell, at a moment of a moving scene.
pub fn write(
    source: &Path,
    scene: &Scene,
    row: &CellRow,
    moment: Option<Moment>,
    out: &Path,
) -> Result<ExportReport> {
    let options = moment.map_or_else(ExportOptions::default, ExportOptions::at);
    let report = export_visible_with(source, scene, &row.set, options, out)?;
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
        .row("primitives", format!("{} of {all}", thousands(report.triangles + report.particles)))
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
