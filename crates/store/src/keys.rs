//! Where everything lies in a dataset folder. The one place that spells keys.
//!
//! ```text
//! current.json                      pointer
//! manifests/00000001.json           immutable, numbered
//! data/<kind>-<hash>.parquet        immutable, named by content
//! bake/<bake>/plan.bin              the plan
//! bake/<bake>/epochs/00000001       coordinator epochs
//! bake/<bake>/content.bin           what the scene is made of
//! bake/<bake>/edit.bin              what it has in common with an earlier bake
//! bake/<bake>/parts/<task>-<attempt>[-cells|-objects].parquet
//! bake/<bake>/parts/<task>-<attempt>-traces.bin
//! bake/<bake>/commits/<task>        finished tasks
//! bake/scene/<hash>                 a file of a scene, named by its content, for workers to fetch
//! bake/probe/                       scratch of the start-up probe
//! ```

/// The pointer to the current manifest.
pub const POINTER: &str = "current.json";
/// Folder of the manifests.
pub const MANIFEST_FOLDER: &str = "manifests";
/// Folder of the bakes' state.
pub const BAKE_FOLDER: &str = "bake";
/// Scratch of the start-up probe.
pub const PROBE_FOLDER: &str = "bake/probe";

/// Folder of the copies of scene files, shared by all bakes.
pub const SCENE_FOLDER: &str = "bake/scene";

const CONTENT: &str = "content.bin";

/// What a part file holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PartKind {
    /// Visible sets of segments.
    Segments,
    /// Rows of cells.
    Cells,
    /// Rows of (cell, object).
    Objects,
    /// What the results depend on.
    Traces,
}

/// Key of a manifest.
#[must_use]
pub fn manifest(number: u64) -> String {
    format!("{MANIFEST_FOLDER}/{number:08}.json")
}

/// The number in a manifest's key.
#[must_use]
pub fn manifest_number(key: &str) -> Option<u64> {
    let digits = key.strip_prefix(MANIFEST_FOLDER)?.strip_prefix('/')?.strip_suffix(".json")?;
    digits.parse().ok()
}

/// Key of a bake's plan.
#[must_use]
pub fn plan(bake: &str) -> String {
    format!("{BAKE_FOLDER}/{bake}/plan.bin")
}

/// Key of what the scene of a bake is made of.
#[must_use]
pub fn content(bake: &str) -> String {
    format!("{BAKE_FOLDER}/{bake}/{CONTENT}")
}

/// The bake that a key of [`content`] belongs to.
#[must_use]
pub fn content_bake(key: &str) -> Option<&str> {
    let bake = key.strip_prefix(BAKE_FOLDER)?.strip_prefix('/')?.strip_suffix(CONTENT)?;
    bake.strip_suffix('/').filter(|bake| !bake.contains('/'))
}

/// Key of what a bake has in common with an earlier one.
#[must_use]
pub fn edit(bake: &str) -> String {
    format!("{BAKE_FOLDER}/{bake}/edit.bin")
}

/// Key of the copy of a scene file with this BLAKE3 hash, hexadecimal.
#[must_use]
pub fn scene_file(blake3: &str) -> String {
    format!("{SCENE_FOLDER}/{blake3}")
}

/// Folder of a bake's coordinator epochs.
#[must_use]
pub fn epochs(bake: &str) -> String {
    format!("{BAKE_FOLDER}/{bake}/epochs")
}

/// Key of a coordinator epoch.
#[must_use]
pub fn epoch(bake: &str, number: u64) -> String {
    format!("{BAKE_FOLDER}/{bake}/epochs/{number:08}")
}

/// Folder of a bake's part files.
#[must_use]
pub fn parts(bake: &str) -> String {
    format!("{BAKE_FOLDER}/{bake}/parts")
}

/// Key of a part file. `attempt` names the attempt and must suit a file name.
#[must_use]
pub fn part(bake: &str, task: u32, attempt: &str, kind: PartKind) -> String {
    let suffix = match kind {
        PartKind::Segments => ".parquet",
        PartKind::Cells => "-cells.parquet",
        PartKind::Objects => "-objects.parquet",
        PartKind::Traces => "-traces.bin",
    };
    format!("{BAKE_FOLDER}/{bake}/parts/{task:08}-{attempt}{suffix}")
}

/// Folder of a bake's commits.
#[must_use]
pub fn commits(bake: &str) -> String {
    format!("{BAKE_FOLDER}/{bake}/commits")
}

/// Key of a task's commit.
#[must_use]
pub fn commit(bake: &str, task: u32) -> String {
    format!("{BAKE_FOLDER}/{bake}/commits/{task:08}")
}

/// The task number in a commit's key.
#[must_use]
pub fn commit_task(key: &str) -> Option<u32> {
    let (folder, task) = key.rsplit_once('/')?;
    if folder.ends_with("/commits") { task.parse().ok() } else { None }
}
