//! `sightline cell`: which cell a position is in, and what matters most there.

use std::fmt::Write;

use serde_json::{Value, json};
use sightline_geometry::{CellId, PrimitiveId};
use sightline_store::{CellRow, Dataset, Weight};

use super::dataset;
use crate::arguments::Cell;
use crate::failure::{Failure, Kind, Result};
use crate::report::{percent, print, print_json};

pub fn run(command: &Cell) -> Result<()> {
    let runtime = super::runtime()?;
    let dataset = runtime.block_on(dataset::open(&command.dataset))?;
    let cell = match (command.cell, command.at) {
        (Some(cell), _) => {
            super::expect_cell(&dataset, cell)?;
            cell
        }
        (None, Some(at)) => match dataset.cell_at(at) {
            Some(cell) => cell,
            None => return Err(nowhere(&dataset, at, command)),
        },
        (None, None) => unreachable!("one of them is required"),
    };
    let chosen = match command.budget {
        None => None,
        Some(budget) => Some(Chosen::new(&runtime.block_on(dataset.cell(cell))?, budget)),
    };
    if command.json {
        let mut out = json!({ "at": command.at, "cell": cell, "nearest": null });
        if let Some(chosen) = &chosen {
            out["budget"] = chosen.to_json();
        }
        print_json(&out);
    } else {
        print(&format!("{cell}\n{}", chosen.map(|c| c.to_text()).unwrap_or_default()));
    }
    Ok(())
}

/// The most important members of a cell.
struct Chosen {
    members: Vec<(PrimitiveId, Weight)>,
    visible: u64,
    /// Share of the view of the members, and of all of the cell's.
    share: f64,
    whole: f64,
}

impl Chosen {
    fn new(row: &CellRow, budget: u64) -> Self {
        let shares = |members: &[(PrimitiveId, Weight)]| -> f64 {
            members.iter().filter_map(|(_, weight)| weight.share()).sum()
        };
        let mut members = row.by_importance();
        let whole = shares(&members);
        members.truncate(usize::try_from(budget).unwrap_or(usize::MAX));
        Self { visible: row.set.len(), share: shares(&members), whole, members }
    }

    fn to_json(&self) -> Value {
        let (primitives, weights): (Vec<u32>, Vec<Option<f64>>) =
            self.members.iter().map(|(p, w)| (p.0, w.share())).unzip();
        json!({
            "primitives": primitives,
            "weights": weights,
            "visible_primitives": self.visible,
            "share": self.share,
            "share_of_all": self.whole,
        })
    }

    fn to_text(&self) -> String {
        let mut text = format!(
            "{} of {} triangles take {} of the view, all of them {}\n",
            self.members.len(),
            self.visible,
            percent(self.share),
            percent(self.whole)
        );
        for (primitive, weight) in &self.members {
            let share = weight.share().map_or("not measured".into(), |s| format!("{s:.3e}"));
            writeln!(text, "{primitive} {share}").expect("a text takes what is written");
        }
        text
    }
}

/// The failure for a position in no cell.
fn nowhere(dataset: &Dataset, at: glam::DVec3, command: &Cell) -> Failure {
    let nearest = nearest(dataset, at);
    if command.json {
        let nearest = nearest.map(|(cell, distance)| json!({ "cell": cell, "distance": distance }));
        print_json(&json!({ "at": at, "cell": null, "nearest": nearest }));
    }
    let failure =
        Failure::new(Kind::Negative, format!("no cell holds {}, {}, {}", at.x, at.y, at.z));
    match nearest {
        Some((cell, distance)) => {
            failure.with_help(format!("the nearest is cell {cell}, {distance:.3} m away"))
        }
        None => failure.with_help("the dataset has no cells"),
    }
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
