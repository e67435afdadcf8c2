//! `sightline info`: what a scene, a dataset or a cell consists of.

use std::path::Path;

use serde_json::{Value, json};
use sightline_geometry::{Bounds, CellId};
use sightline_scene::{IngestReport, OpenOptions, Scene};
use sightline_store::{CellRow, Dataset, is_url, redacted};

use super::dataset::{self, Summary};
use crate::arguments::Info;
use crate::failure::{Failure, Kind, Result};
use crate::memory::Phases;
use crate::report::{Table, bytes, count, percent, print, print_json, thousands};

pub fn run(command: &Info) -> Result<()> {
    let location = command.path.display().to_string();
    if is_dataset(&command.path) {
        let runtime = super::runtime()?;
        return runtime.block_on(async {
            let dataset = dataset::open(&location).await?;
            match command.cell {
                Some(cell) => describe_cell(&dataset, cell, command).await,
                None => describe_dataset(&dataset, command).await,
            }
        });
    }
    if command.cell.is_some() {
        return Err(Failure::new(Kind::Usage, "--cell asks for a cell, but PATH is no dataset")
            .with_help("give the folder of a dataset"));
    }
    let found = super::scene::locate(&command.path, &[], &command.cache);
    let found = super::runtime()?.block_on(found)?;
    describe_scene(&found.path, command)
}

/// True for a folder, and for a URL that does not name a file of a scene.
fn is_dataset(path: &Path) -> bool {
    let names_a_scene = || {
        let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        ending.is_some_and(|e| ["gltf", "glb", "parquet", "csv"].contains(&e.as_str()))
    };
    path.is_dir() || (is_url(&path.to_string_lossy()) && !names_a_scene())
}

fn box_text(bounds: Bounds) -> String {
    if bounds.is_empty() {
        return "empty".into();
    }
    let ([x0, y0, z0], [x1, y1, z1]) = (bounds.min.to_array(), bounds.max.to_array());
    format!("x {x0:.2} to {x1:.2}, y {y0:.2} to {y1:.2}, z {z0:.2} to {z1:.2} m")
}

fn box_json(bounds: Bounds) -> Value {
    if bounds.is_empty() { Value::Null } else { json!({ "min": bounds.min, "max": bounds.max }) }
}

fn describe_scene(path: &Path, command: &Info) -> Result<()> {
    let mut phases = Phases::start("read");
    let scene = Scene::open(path, &OpenOptions::default())?;
    phases.finish();
    if command.json {
        print_json(&scene_json(&scene, &redacted(&command.path.display().to_string()), &phases));
        return Ok(());
    }
    let mut table = Table::default();
    let report = &scene.report;
    table
        .row("scene", redacted(&command.path.display().to_string()))
        .row("written by", report.generator.clone().unwrap_or_else(|| "unknown".into()))
        .row("digest", &scene.digest.combined[..16])
        .row("bounds", box_text(scene.geometry.bounds))
        .row("triangles", thousands(report.instanced_triangles))
        .row("particles", thousands(report.particles))
        .row("unique triangles", thousands(report.unique_triangles))
        .row("unique vertices", thousands(report.unique_vertices))
        .row("objects", thousands(report.objects))
        .row("meshes", thousands(report.meshes))
        .row("instances", thousands(report.instances))
        .row("see-through", count(report.see_through_triangles, "triangle"));
    phases.add_to(&mut table);
    let mut text = table.to_string();
    text.push_str(&leftovers(report, command.limit));
    text.push_str(&objects(&scene, command.limit));
    print(&text);
    Ok(())
}

fn scene_json(scene: &Scene, path: &str, phases: &Phases) -> Value {
    let objects: Vec<Value> = scene
        .objects
        .iter()
        .map(|o| {
            json!({
                "id": o.id, "name": o.name, "path": o.path, "node": o.node,
                "first_primitive": o.primitives.start, "end_primitive": o.primitives.end,
                "occluder": o.occluder, "bounds": box_json(o.bounds),
            })
        })
        .collect();
    json!({
        "kind": "scene",
        "path": path,
        "digest": scene.digest,
        "bounds": box_json(scene.geometry.bounds),
        "report": scene.report,
        "objects": objects,
        "time": phases.to_json(),
    })
}

/// What reading left out, and what deserves a look.
fn leftovers(report: &IngestReport, limit: usize) -> String {
    let mut table = Table::default();
    let skipped = report.skipped;
    let counted = [
        ("points", skipped.points, "primitive"),
        ("lines", skipped.lines, "primitive"),
        ("without positions", skipped.without_positions, "primitive"),
        ("hidden", report.hidden_nodes, "node"),
        ("flattened by a scale of 0", report.flattened_instances, "instance"),
        ("degenerate", report.degenerate_triangles, "triangle"),
    ];
    for (label, n, noun) in counted.into_iter().filter(|c| c.1 > 0) {
        table.row(format!("  {label}"), count(n, noun));
    }
    for place in report.degenerate.iter().take(limit) {
        let listed: Vec<String> = place.triangles.iter().take(limit).map(u32::to_string).collect();
        let more = if place.count > listed.len() as u64 { ", ..." } else { "" };
        table.row(
            format!("    mesh {}, primitive {}", place.mesh, place.primitive),
            format!("{}: {}{more}", count(place.count, "triangle"), listed.join(", ")),
        );
    }
    if report.degenerate.len() > limit {
        table.row(format!("    and {} more places", report.degenerate.len() - limit), "");
    }
    let mut text = String::new();
    let table = table.to_string();
    if !table.is_empty() {
        text.push_str(&format!("\nLeft out:\n{table}"));
    }
    if !report.used_extensions.is_empty() {
        text.push_str(&format!("\nExtensions: {}\n", report.used_extensions.join(", ")));
    }
    if !report.ignored_extensions.is_empty() {
        text.push_str(&format!("Ignored: {}\n", report.ignored_extensions.join(", ")));
    }
    for warning in &report.warnings {
        text.push_str(&format!("Warning: {warning}\n"));
    }
    text
}

fn objects(scene: &Scene, limit: usize) -> String {
    let mut table = Table::default();
    for object in scene.objects.iter().take(limit) {
        let kind = if object.occluder { "" } else { ", see-through" };
        table.row(
            format!("  {} {}", object.id, object.path),
            format!("{}{kind}", count(object.primitives.len() as u64, "triangle")),
        );
    }
    if scene.objects.len() > limit {
        let more = count((scene.objects.len() - limit) as u64, "more object");
        table.row(format!("  and {more}; see --limit"), "");
    }
    format!("\nObjects:\n{table}")
}

async fn describe_dataset(dataset: &Dataset, command: &Info) -> Result<()> {
    let summary = Summary::of(dataset).await?;
    let manifest = dataset.manifest();
    if command.json {
        print_json(&json!({
            "kind": "dataset",
            "path": command.path,
            "number": dataset.number(),
            "manifest": manifest,
            "summary": summary.to_json(),
        }));
        return Ok(());
    }
    let mut table = Table::default();
    table
        .row("dataset", format!("{}, manifest {}", command.path.display(), dataset.number()))
        .row(
            "scene",
            format!(
                "{} ({})",
                manifest.scene.uri,
                manifest.scene.hash.chars().take(16).collect::<String>()
            ),
        )
        .row("objects", thousands(manifest.scene.objects))
        .row("states", thousands(u64::from(manifest.states)));
    summary.add_to(&mut table);
    if let Some(b) = manifest.bounds {
        table.row("view region", box_text(Bounds { min: b.min.into(), max: b.max.into() }));
    }
    for (reason, n) in &manifest.skipped {
        table.row(format!("skipped: {reason}"), count(*n, "cell"));
    }
    let totals = &manifest.totals;
    let bits = 8.0 * totals.set_bytes as f64 / totals.primitives.max(1) as f64;
    let rows = dataset.cells().iter().flat_map(|cell| {
        let runs = dataset.runs(cell.cell.id);
        std::iter::once(cell).chain(if runs.len() > 1 { runs } else { &[] })
    });
    let weights: u64 = rows.map(|row| u64::from(row.set.weights_bytes)).sum();
    let weight_bits = 8.0 * weights as f64 / totals.primitives.max(1) as f64;
    table
        .row("sets", format!("{} ({bits:.2} bits a member)", bytes(totals.set_bytes)))
        .row("weights", format!("{} ({weight_bits:.2} bits a member)", bytes(weights)));
    table.row(
        "files",
        format!("{} in {}", bytes(totals.file_bytes), count(manifest.files.len() as u64, "file")),
    );
    let config = serde_json::to_string_pretty(&manifest.config).unwrap_or_default();
    print(&format!("{table}\nConfiguration:\n{config}\n"));
    Ok(())
}

/// Shares of what is seen, for which the number of triangles is told.
const SHARES: [f64; 3] = [0.9, 0.99, 0.999];

/// For each of [`SHARES`], how many of the most important triangles take so much of what the cell
/// sees. Empty where nothing has a weight.
fn shares(row: &CellRow) -> Vec<(f64, usize)> {
    let weights: Vec<f64> = row.by_importance().iter().filter_map(|(_, w)| w.share()).collect();
    let whole: f64 = weights.iter().sum();
    let sums: Vec<f64> = weights
        .iter()
        .scan(0.0, |sum, weight| {
            *sum += weight;
            Some(*sum)
        })
        .collect();
    let needed = |share: f64| sums.partition_point(|sum| *sum < share * whole) + 1;
    let known = SHARES.iter().filter(|_| !sums.is_empty());
    known.map(|&share| (share, needed(share).min(sums.len()))).collect()
}

fn needed(row: &CellRow) -> String {
    let texts: Vec<String> = shares(row)
        .iter()
        .map(|(share, n)| format!("{} for {:.1} %", thousands(*n as u64), 100.0 * share))
        .collect();
    if texts.is_empty() {
        return "unknown: the dataset has no weights".into();
    }
    format!("{} of what is seen", texts.join(", "))
}

/// The runs of states of a cell, for people.
fn states_text(dataset: &Dataset, cell: CellId) -> String {
    let runs = dataset.runs(cell);
    let sizes = || runs.iter().map(|run| u64::from(run.primitives));
    let states = count(u64::from(dataset.states()), "state");
    if runs.len() < 2 {
        return format!("{states}, the same in all");
    }
    let (least, most) = (sizes().min().unwrap_or(0), sizes().max().unwrap_or(0));
    let (least, most) = (thousands(least), thousands(most));
    format!("{states} in {} of {least} to {most} visible", count(runs.len() as u64, "run"))
}

async fn describe_cell(dataset: &Dataset, cell: CellId, command: &Info) -> Result<()> {
    super::expect_cell(dataset, cell)?;
    let row = dataset.cell(cell).await?;
    let effort = row.effort;
    let objects = dataset.objects().await?;
    let mut pairs = dataset.object_rows(cell).await?;
    pairs.sort_by(|a, b| b.weight.total_cmp(&a.weight).then(a.object.cmp(&b.object)));
    let name = |id: sightline_geometry::ObjectId| objects.get(id.index()).map_or("", |o| &o.path);
    if command.json {
        let objects: Vec<Value> = pairs
            .iter()
            .map(|p| {
                json!({
                    "object": p.object, "path": name(p.object), "weight": p.weight,
                    "visible_primitives": p.visible_primitives,
                    "total_primitives": p.total_primitives,
                    "first_state": p.first_state, "last_state": p.last_state,
                })
            })
            .collect();
        let states: Vec<Value> = dataset
            .runs(cell)
            .iter()
            .map(|run| {
                json!({
                    "first_state": run.first_state, "last_state": run.last_state,
                    "visible_primitives": run.primitives,
                })
            })
            .collect();
        print_json(&json!({
            "kind": "cell",
            "path": command.path,
            "cell": cell,
            "tile": row.tile,
            "corners": row.cell.corners,
            "height": row.cell.height,
            "visible_primitives": row.set.len(),
            "states": states,
            "set_runs": row.set.runs().len(),
            "segments": effort.segments,
            "runs": effort.runs,
            "lines": effort.lines,
            "rows": effort.rows,
            "solver_rays": effort.solver_rays,
            "skipped_movers": effort.skipped_movers,
            "refinements": effort.refinements,
            "heldout_viewpoints": effort.heldout_viewpoints,
            "heldout_rays": effort.heldout_rays,
            "heldout_error_mean": effort.heldout_error_mean,
            "heldout_error_upper": effort.heldout_error_upper,
            "heldout_error_max": effort.heldout_error_max,
            "target_met": effort.target_met,
            "needed_for": shares(&row),
            "objects": objects,
        }));
        return Ok(());
    }
    let kind = if dataset.manifest().scene.particles > 0 { "primitive" } else { "triangle" };
    let mut table = Table::default();
    table
        .row("cell", format!("{cell}, tile {}, {}", row.tile[0], row.tile[1]))
        .row("box", box_text(row.cell.bounds()))
        .row(
            "visible",
            format!(
                "{} of {} in {}",
                count(row.set.len(), kind),
                thousands(dataset.manifest().scene.primitives()),
                count(row.set.runs().len() as u64, "run")
            ),
        )
        .row("states", states_text(dataset, cell))
        .row("objects", thousands(pairs.len() as u64))
        .row("needed", needed(&row))
        .row(
            "solved",
            format!(
                "{} in {} and {}, up to {}; {} rays",
                count(u64::from(effort.segments), "segment"),
                count(u64::from(effort.runs), "run"),
                count(u64::from(effort.lines), "line"),
                count(u64::from(effort.rows), "row"),
                thousands(effort.solver_rays)
            ),
        )
        .row("hidden movers", format!("skipped {} times", thousands(effort.skipped_movers)))
        .row("refinements", thousands(u64::from(effort.refinements)))
        .row(
            "pixel error",
            format!(
                "mean {}, below {} with 95 % confidence, worst viewpoint {} ({} held-out rays)",
                percent(effort.heldout_error_mean),
                percent(effort.heldout_error_upper),
                percent(effort.heldout_error_max),
                thousands(effort.heldout_rays)
            ),
        )
        .row("target", if effort.target_met { "met" } else { "not met" });
    let mut list = Table::default();
    for pair in pairs.iter().take(command.limit) {
        list.row(
            format!("  {} {}", pair.object, name(pair.object)),
            format!(
                "{:>8.4} %  {} of {}",
                100.0 * pair.weight,
                thousands(u64::from(pair.visible_primitives)),
                count(u64::from(pair.total_primitives), kind)
            ),
        );
    }
    if pairs.len() > command.limit {
        let more = count((pairs.len() - command.limit) as u64, "more object");
        list.row(format!("  and {more}; see --limit"), "");
    }
    print(&format!("{table}\nObjects by their share of the view:\n{list}"));
    Ok(())
}
