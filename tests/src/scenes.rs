//! The scenes that tests bake: a generated city, and real scenes that are not in the repository.

use std::path::PathBuf;

use crate::{requirement, workspace};

/// The environment variable that names the folder of the real scenes.
pub const SCENES: &str = "SIGHTLINE_SCENES";

/// A real scene, by its path in the folder of shared scenes: `$SIGHTLINE_SCENES`, else
/// `../shared/scenes` beside the repository. Skips `test` loudly where it is absent.
#[must_use]
pub fn shared(test: &str, path: &str) -> Option<PathBuf> {
    let beside = || workspace::root().join("../shared/scenes");
    let folder = std::env::var_os(SCENES).map_or_else(beside, PathBuf::from);
    let scene = folder.join(path);
    if !scene.is_file() {
        requirement::skip(test, &format!("no {}; {SCENES} names the folder", scene.display()));
        return None;
    }
    Some(scene)
}
