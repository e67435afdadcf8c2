//! `sightline verify`: the pixel error of a dataset, measured with rays.
//!
//! Everything printed can be repeated: viewpoints and directions follow from the seed, the cell
//! and the viewpoint's number, and the worst viewpoint comes with a command that measures it
//! alone, to the same count of wrong rays. Where the scene moves, each viewpoint is looked at at a random
//! moment, and what counts is the set of the moment's state.

use std::time::Instant;

use serde_json::{Value, json};
use sightline_geometry::{CellId, Moment, StateSets, Timeline, ViewCell};
use sightline_quality::{
    CellError, Suspect, ViewpointError, measure_cell_over, measure_viewpoint_at,
};
use sightline_scene::Scene;
use sightline_store::{CellRow, Dataset};

use super::dataset::open_with_scene;
use crate::arguments::{CellChoice, Verify};
use crate::failure::{Failure, Kind, Result};
use crate::memory::{add_held, held_json};
use crate::progress::Progress;
use crate::report::{Table, count, duration, percent, print, print_json, thousands};

/// Upper ends of the histogram's classes, share of pixels; the last class has none.
const CLASSES: [f64; 7] = [0.0, 1e-5, 5e-5, 2e-4, 1e-3, 5e-3, 5e-2];

/// The viewpoint with the largest error.
#[derive(Clone, Copy, Debug)]
struct Worst {
    cell: CellId,
    error: ViewpointError,
}

/// What was measured so far.
#[derive(Clone, Debug, Default)]
pub struct Findings {
    cells: u64,
    viewpoints: u64,
    rays: u64,
    sum: f64,
    histogram: [u64; CLASSES.len() + 1],
    worst: Option<Worst>,
    seconds: f64,
    /// What the bake itself measured in these cells: the sum of the mean errors, and the number of
    /// cells whose target was met.
    baked_sum: f64,
    baked_met: u64,
}

impl Findings {
    /// Mean error over the viewpoints, share of pixels.
    pub fn mean(&self) -> f64 {
        self.sum / self.viewpoints.max(1) as f64
    }

    /// Error of the worst viewpoint, share of pixels.
    pub fn max(&self) -> f64 {
        self.worst.map_or(0.0, |w| w.error.error)
    }

    fn add(&mut self, cell: &CellError) {
        self.cells += 1;
        for error in &cell.viewpoints {
            self.viewpoints += 1;
            self.rays += u64::from(error.rays);
            self.sum += error.error;
            let class = CLASSES.partition_point(|end| *end < error.error);
            self.histogram[class] += 1;
            if self.worst.is_none_or(|w| error.error > w.error.error) {
                self.worst = Some(Worst { cell: cell.cell, error: *error });
            }
        }
    }

    /// Mean over the cells of the error that the bake measured, share of pixels.
    fn baked_mean(&self) -> f64 {
        self.baked_sum / self.cells.max(1) as f64
    }

    fn rays_per_second(&self) -> f64 {
        self.rays as f64 / self.seconds.max(1e-9)
    }
}

/// Runs the command; the exit code is 1 when a limit is exceeded.
pub fn run(command: &Verify) -> Result<()> {
    let runtime = super::runtime()?;
    let (dataset, scene, _) = runtime.block_on(open_with_scene(&command.input))?;
    let findings =
        super::on_threads(command.threads, || measure(&runtime, &dataset, &scene, command))??;
    let exceeded = exceeded(&findings, command);
    if command.json {
        let mut found = to_json(&findings, command, &exceeded);
        found["memory"] = held_json(scene.memory.as_deref());
        print_json(&found);
    } else {
        let mut table = Table::default();
        if let Some(keeper) = &scene.memory {
            table.gap();
            add_held(&mut table, &keeper.held());
        }
        print(&format!("{}{table}", to_text(&findings, command)));
    }
    if exceeded.is_empty() {
        return Ok(());
    }
    Err(Failure::new(Kind::Negative, exceeded.join("; ")).with_help(
        "bake with a smaller --target-error or more --rounds; `sightline info` tells whether the \
         bake's own target was met",
    ))
}

/// Measures the cells that the command chooses.
pub fn measure(
    runtime: &tokio::runtime::Runtime,
    dataset: &Dataset,
    scene: &Scene,
    command: &Verify,
) -> Result<Findings> {
    let cells = choose(dataset, command)?;
    let mut findings = Findings::default();
    let started = Instant::now();
    let mut progress = Progress::new("verify", "cells", cells.len() as u64);
    for (done, &cell) in (0..).zip(&cells) {
        progress.set(done, &format!("mean error {}", percent(findings.mean())));
        let row = runtime.block_on(dataset.cell(cell))?;
        expect_members(&row, scene)?;
        let sets = runtime.block_on(dataset.state_sets(cell))?;
        findings.add(&measure_row(scene, &row.cell, &sets, dataset.timeline(), command)?);
        findings.baked_sum += row.effort.heldout_error_mean;
        findings.baked_met += u64::from(row.effort.target_met);
    }
    drop(progress);
    findings.seconds = started.elapsed().as_secs_f64();
    Ok(findings)
}

fn measure_row(
    scene: &Scene,
    cell: &ViewCell,
    sets: &StateSets,
    timeline: &Timeline,
    command: &Verify,
) -> Result<CellError> {
    let Verify { viewpoints, rays, seed, .. } = *command;
    let Some(viewpoint) = command.viewpoint else {
        return Ok(measure_cell_over(
            &scene.geometry,
            sets,
            timeline,
            cell,
            viewpoints,
            rays,
            seed,
        ));
    };
    let moment = command.moment.unwrap_or(Moment::START);
    if !sets.states().contains(&moment.state) {
        let states = count(u64::from(sets.states().end), "state");
        return Err(Failure::new(
            Kind::Usage,
            format!("there is no state {}: the dataset has {states}", moment.state),
        )
        .with_help("give --moment=STATE,T with a state from 0 and T from 0 to 1"));
    }
    let at = Suspect { viewpoint, moment };
    let error = measure_viewpoint_at(&scene.geometry, sets, at, rays, seed);
    Ok(CellError { cell: cell.id, viewpoints: vec![error], missing: Vec::new() })
}

fn choose(dataset: &Dataset, command: &Verify) -> Result<Vec<CellId>> {
    let all: Vec<CellId> = dataset.cells().iter().map(|e| e.cell.id).collect();
    if let Some(cell) = command.cell {
        super::expect_cell(dataset, cell)?;
        return Ok(vec![cell]);
    }
    Ok(match command.cells {
        CellChoice::All => all,
        CellChoice::Spread(n) => {
            let n = (n as usize).min(all.len());
            (0..n).map(|k| all[(2 * k + 1) * all.len() / (2 * n)]).collect()
        }
    })
}

fn expect_members(row: &CellRow, scene: &Scene) -> Result<()> {
    let (end, count) =
        (row.set.runs().last().map_or(0, |r| r.end), scene.geometry.primitive_count());
    if end <= count {
        return Ok(());
    }
    Err(Failure::new(
        Kind::Input,
        format!("cell {} holds primitive {}, the scene has {count}", row.cell.id, end - 1),
    )
    .with_help("the dataset is damaged; bake again"))
}

fn exceeded(findings: &Findings, command: &Verify) -> Vec<String> {
    let over = |name: &str, found: f64, limit: Option<f64>| {
        // A NaN limit is exceeded, too.
        let limit = limit.filter(|limit| found > *limit || limit.is_nan())?;
        Some(format!("the {name} pixel error is {}, more than {}", percent(found), percent(limit)))
    };
    [
        over("mean", findings.mean(), command.max_mean),
        over("worst", findings.max(), command.max_worst),
    ]
    .into_iter()
    .flatten()
    .collect()
}

/// The command that measures the worst viewpoint again.
fn reproduce(worst: &Worst, command: &Verify) -> String {
    let at = worst.error.viewpoint;
    let shown = |location: &str| super::quoted(&sightline_store::redacted(location));
    let mut text = format!("sightline verify {}", shown(&command.input.dataset));
    if let Some(scene) = &command.input.scene {
        text.push_str(&format!(" --scene {}", shown(&scene.display().to_string())));
    }
    // The shortest decimal form of an f64 reads back to the same bits.
    text.push_str(&format!(
        " --cell {} --viewpoint={},{},{} --rays {} --seed {}",
        worst.cell, at.x, at.y, at.z, worst.error.rays, worst.error.seed
    ));
    let moment = worst.error.moment;
    if moment != Moment::START {
        text.push_str(&format!(" --moment={},{}", moment.state, moment.t));
    }
    text
}

fn to_json(findings: &Findings, command: &Verify, exceeded: &[String]) -> Value {
    let classes = CLASSES.iter().copied().map(Some).chain([None]);
    let histogram: Vec<Value> = classes
        .zip(findings.histogram)
        .map(|(up_to, viewpoints)| json!({ "up_to": up_to, "viewpoints": viewpoints }))
        .collect();
    let worst = findings.worst.map(|w| {
        json!({
            "cell": w.cell,
            "viewpoint": w.error.viewpoint,
            "moment": w.error.moment,
            "rays": w.error.rays,
            "wrong": w.error.wrong,
            "error": w.error.error,
            "seed": w.error.seed,
            "command": reproduce(&w, command),
        })
    });
    json!({
        "dataset": sightline_store::redacted(&command.input.dataset),
        "cells": findings.cells,
        "viewpoints": findings.viewpoints,
        "rays": findings.rays,
        "seed": command.seed,
        "error_mean": findings.mean(),
        "error_max": findings.max(),
        "histogram": histogram,
        "worst": worst,
        "limits": { "max_mean": command.max_mean, "max_worst": command.max_worst },
        "exceeded": exceeded,
        "baked": { "error_mean": findings.baked_mean(), "targets_met": findings.baked_met },
        "seconds": findings.seconds,
        "rays_per_second": findings.rays_per_second(),
    })
}

/// The findings for people.
pub fn to_text(findings: &Findings, command: &Verify) -> String {
    let mut table = Table::default();
    table
        .row("cells", thousands(findings.cells))
        .row("viewpoints", thousands(findings.viewpoints))
        .row("rays", thousands(findings.rays))
        .row("mean pixel error", percent(findings.mean()))
        .row("worst pixel error", percent(findings.max()))
        .row(
            "said by the bake",
            format!(
                "mean {}, target met in {} of {}",
                percent(findings.baked_mean()),
                thousands(findings.baked_met),
                count(findings.cells, "cell")
            ),
        )
        .row(
            "time",
            format!(
                "{} ({} rays/s)",
                duration(findings.seconds),
                thousands(findings.rays_per_second() as u64)
            ),
        );
    let mut text = format!("{table}\nViewpoints by pixel error:\n{}", histogram(findings));
    if let Some(worst) = findings.worst.filter(|w| w.error.wrong > 0) {
        text.push_str(&format!(
            "\nWorst viewpoint: {} of {} wrong, in cell {}. To measure it again:\n  {}\n",
            thousands(u64::from(worst.error.wrong)),
            count(u64::from(worst.error.rays), "ray"),
            worst.cell,
            reproduce(&worst, command)
        ));
    }
    text
}

fn histogram(findings: &Findings) -> String {
    let mut table = Table::default();
    let largest = findings.histogram.iter().max().copied().unwrap_or(0).max(1);
    for (class, &viewpoints) in findings.histogram.iter().enumerate() {
        let label = match CLASSES.get(class) {
            Some(end) if *end == 0.0 => "  none".to_owned(),
            Some(end) => format!("  up to {} %", 100.0 * end),
            None => format!("  above {} %", 100.0 * CLASSES[CLASSES.len() - 1]),
        };
        // 40 characters for the most frequent class; anything there shows.
        let bar = "#".repeat((40 * viewpoints).div_ceil(largest) as usize);
        table.row(label, format!("{:>9} {bar}", thousands(viewpoints)));
    }
    table.to_string()
}
