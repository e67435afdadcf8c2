//! `sightline demo`: everything once, on a generated city.

use std::path::Path;

use sightline_scene::generate::Kind as Generated;

use super::bake::bake;
use super::dataset::open_with_scene;
use super::{export, generate, verify};
use crate::arguments::{
    BakeInput, CacheFlags, CellChoice, ConfigFlags, DatasetInput, Demo, MemoryFlags, Verify,
};
use crate::failure::{Failure, Kind, Result};
use crate::progress::note;
use crate::report::{bytes, print, thousands};

/// Edge of a cell, metres: two side by side fill the free width of the street.
const CELL_SIZE: f64 = 5.0;
/// Cells along x and z. A cell takes less than a core-second to bake, and as long to verify.
const CELLS: [u32; 2] = [2, 14];

pub fn run(command: &Demo) -> Result<()> {
    let folder = &command.out;
    std::fs::create_dir_all(folder)
        .map_err(|e| Failure::io(Kind::Store, "make the folder", folder, &e))?;
    let scene = folder.join("city.glb");
    note(&format!("1 of 4: generating {}", scene.display()));
    let made = generate::write(Generated::City, command.triangles, 1, &scene)?;
    note(&format!("   {} triangles, {}", thousands(made.triangles), bytes(made.bytes)));

    note("2 of 4: baking");
    let out = folder.join("visible").display().to_string();
    let input = BakeInput {
        scene: scene.clone(),
        out: out.clone(),
        config: None,
        memory: MemoryFlags::default(),
        keys: configuration(made.suggested_region, made.suggested_eye_height),
        cache: CacheFlags::default(),
    };
    let baked = bake(&input, command.threads, &super::Joining::default())?;
    print(&format!("{}\n", baked.to_text()));

    note("3 of 4: verifying");
    let dataset = DatasetInput {
        dataset: out.clone(),
        scene: Some(scene.clone()),
        cache: CacheFlags::default(),
        memory: MemoryFlags::default(),
    };
    let check = verification(dataset, command.threads);
    let runtime = super::runtime()?;
    let (opened, geometry, _) = runtime.block_on(open_with_scene(&check.input))?;
    let findings = super::on_threads(command.threads, || {
        verify::measure(&runtime, &opened, &geometry, &check)
    })??;
    print(&format!("{}\n", verify::to_text(&findings, &check)));

    note("4 of 4: exporting a cell");
    let middle = opened.cells()[opened.cells().len() / 2].cell.clone();
    let row = runtime.block_on(opened.cell(middle.id))?;
    let exported = folder.join("cell.glb");
    let report = export::write(&scene, &geometry, &row, None, &exported)?;
    print(&export::to_text(&report, &row, &geometry, &exported));
    print(&next_steps(folder, &out, &exported, middle.center()));
    Ok(())
}

/// A stretch of the city's main street.
fn configuration(region: [f64; 4], eyes: [f64; 2]) -> ConfigFlags {
    let [x0, z0, x1, z1] = region;
    let middle = [(x0 + x1) / 2.0, (z0 + z1) / 2.0];
    let half = CELLS.map(|n| 0.5 * CELL_SIZE * f64::from(n));
    let stretch = [
        (middle[0] - half[0]).max(x0),
        (middle[1] - half[1]).max(z0),
        (middle[0] + half[0]).min(x1),
        (middle[1] + half[1]).min(z1),
    ];
    ConfigFlags {
        overrides: vec![
            ("region.rectangles", format!("[{stretch:?}]")),
            ("region.cell_size", format!("{CELL_SIZE:?}")),
            ("region.eye_height", format!("{eyes:?}")),
            // The eye heights are close together: one perimeter, in the middle, is enough.
            ("solver.rings", "1".into()),
            // Small tasks, so that progress is seen; the dataset does not depend on them.
            ("tasks.segments_per_task", "8".into()),
            ("tasks.cells_per_task", "2".into()),
        ],
    }
}

fn verification(input: DatasetInput, threads: Option<u32>) -> Verify {
    Verify {
        input,
        viewpoints: 10,
        rays: 100_000,
        cells: CellChoice::All,
        cell: None,
        viewpoint: None,
        moment: None,
        seed: 1,
        max_mean: None,
        max_worst: None,
        threads,
        json: false,
    }
}

fn next_steps(folder: &Path, out: &str, exported: &Path, at: glam::DVec3) -> String {
    let out = super::quoted(out);
    format!(
        "\nAll of it is in {}. Where to look next:\n\
         - drop {} into https://gltf-viewer.donmccurdy.com or Blender: what one cell sees\n\
         - {out}/data/*.parquet are plain Parquet: DuckDB, Polars and Spark read them\n\
         - sightline info {out}\n\
         - sightline info {out} --cell 0\n\
         - sightline export {out} --cell 0 -o cell-0.glb\n\
         - sightline bake --help\n\
         - sightline cell {out} --at={},{},{}\n",
        folder.display(),
        exported.display(),
        at.x,
        at.y,
        at.z,
    )
}
