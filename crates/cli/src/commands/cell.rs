//! `sightline cell`: which cell a position is in.

use serde_json::json;
use sightline_geometry::CellId;
use sightline_store::Dataset;

use super::dataset;
use crate::arguments::Cell;
use crate::failure::{Failure, Kind, Result};
use crate::report::{print, print_json};

pub fn run(command: &Cell) -> Result<()> {
    let dataset = super::runtime()?.block_on(dataset::open(&command.dataset))?;
    let at = command.at;
    let found = dataset.cell_at(at);
    let nearest = if found.is_some() { None } else { nearest(&dataset, at) };
    if command.json {
        let nearest = nearest.map(|(cell, distance)| json!({ "cell": cell, "distance": distance }));
        print_json(&json!({ "at": at, "cell": found, "nearest": nearest }));
    } else if let Some(cell) = found {
        print(&format!("{cell}\n"));
    }
    if found.is_some() {
        return Ok(());
    }
    let failure =
        Failure::new(Kind::Negative, format!("no cell holds {}, {}, {}", at.x, at.y, at.z));
    Err(match nearest {
        Some((cell, distance)) => {
            failure.with_help(format!("the nearest is cell {cell}, {distance:.3} m away"))
        }
        None => failure.with_help("the dataset has no cells"),
    })
}

/// The cell whose box is nearest to a point, and the distance, metres.
fn nearest(dataset: &Dataset, at: glam::DVec3) -> Option<(CellId, f64)> {
    let distance = |cell: &sightline_geometry::ViewCell| {
        let bounds = cell.bounds();
        (at - at.clamp(bounds.min, bounds.max)).length()
    };
    let all = dataset.cells().iter().map(|e| (e.cell.id, distance(&e.cell)));
    all.min_by(|a, b| a.1.total_cmp(&b.1))
}
