//! A small generated city and the bake of one of its streets: quick enough to be baked again and
//! again, large enough to be interrupted half-way.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde_json::Value;

use crate::binaries::sightline;
use crate::process;

/// Longest time that a command on the city may take; far more than it needs, even beside others.
pub const LIMIT: Duration = Duration::from_secs(300);

/// Flags of the bake but scene and folder: a stretch of the street at x = 0, cells of 5 m.
const STREET: [&str; 8] = [
    "--region=-5,-10,5,10",
    "--cell-size=5",
    "--eye-height=1.5,1.8",
    "--rows=92",
    "--target-error=0.0001",
    "--worst-error=0.001",
    "--rounds=3",
    "--verticals=false",
];

/// Cells of that stretch.
pub const CELLS: u32 = 8;

/// Segments and cells of a task of the shared bake.
pub const TASK_UNITS: [u32; 2] = [4, 2];

/// A city, baked once by `sightline bake`.
#[derive(Debug)]
pub struct City {
    /// Folder of everything.
    pub folder: PathBuf,
    /// The scene.
    pub scene: PathBuf,
    /// The dataset.
    pub dataset: PathBuf,
    /// What `bake --json` said.
    pub summary: Value,
}

impl City {
    /// Generates and bakes into an empty `folder`.
    ///
    /// # Panics
    /// When a command fails.
    #[must_use]
    pub fn bake(folder: &Path) -> Self {
        // Left over from the last run of the tests, or not there.
        let _ = std::fs::remove_dir_all(folder);
        std::fs::create_dir_all(folder).expect("a folder can be made");
        let (scene, dataset) = (folder.join("city.glb"), folder.join("baked"));
        generate(&scene, 7);
        let mut command = sightline(bake_arguments("bake", &scene, &dataset, TASK_UNITS));
        let ended = process::run(command.arg("--json"), LIMIT).success();
        let summary = ended.json();
        Self { folder: folder.to_owned(), scene, dataset, summary }
    }

    /// An empty folder of one test, beside the city.
    ///
    /// # Panics
    /// When a test has taken the name already.
    #[must_use]
    pub fn empty(&self, name: &str) -> PathBuf {
        let folder = self.folder.join(name);
        std::fs::create_dir(&folder).expect("a folder can be made once");
        folder
    }
}

/// Generates a small city.
///
/// # Panics
/// When the command fails.
pub fn generate(scene: &Path, seed: u32) {
    let mut command = sightline(["generate", "city", "--triangles", "30k", "--seed"]);
    let _ = process::run(command.arg(seed.to_string()).arg("-o").arg(scene), LIMIT).success();
}

/// `bake` or `coordinator`, of the street of the city. `units` are the segments and the cells of a
/// task: few, so that there is something to kill and to resume.
#[must_use]
pub fn bake_arguments(command: &str, scene: &Path, out: &Path, units: [u32; 2]) -> Vec<OsString> {
    let mut arguments: Vec<OsString> =
        vec![command.into(), scene.into(), "--out".into(), out.into()];
    arguments.extend(STREET.map(OsString::from));
    arguments.push(format!("--segments-per-task={}", units[0]).into());
    arguments.push(format!("--cells-per-task={}", units[1]).into());
    arguments
}
