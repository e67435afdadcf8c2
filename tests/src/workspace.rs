//! The workspace as cargo sees it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;

/// Top folder of the repository.
#[must_use]
pub fn root() -> &'static Path {
    static ROOT: OnceLock<PathBuf> = OnceLock::new();
    ROOT.get_or_init(|| {
        let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
        tests.parent().expect("the tests are in a folder of the repository").to_owned()
    })
}

/// A text file of the repository.
///
/// # Panics
/// When it cannot be read.
#[must_use]
pub fn read(path: impl AsRef<Path>) -> String {
    let path = root().join(path);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("cannot read {}: {e}", path.display()))
}

/// A package: of the workspace, or one that it depends on.
#[derive(Clone, Debug)]
pub struct Package {
    /// Name as on the registry.
    pub name: String,
    /// Version.
    pub version: String,
    /// SPDX expression, as the package states it.
    pub licence: Option<String>,
    /// Folder of its `Cargo.toml`.
    pub folder: PathBuf,
    /// True for the packages of this repository.
    pub is_member: bool,
    /// Ids of what it is linked with or built by; development dependencies are left out.
    pub dependencies: BTreeSet<String>,
}

/// Packages by id, resolved for the machine that runs the tests.
#[derive(Clone, Debug)]
pub struct Workspace {
    /// All packages.
    pub packages: BTreeMap<String, Package>,
}

impl Workspace {
    /// Asks cargo, once.
    ///
    /// # Panics
    /// When cargo fails, as it does where `Cargo.lock` is out of date.
    #[must_use]
    pub fn get() -> &'static Self {
        static WORKSPACE: OnceLock<Workspace> = OnceLock::new();
        WORKSPACE.get_or_init(|| Self::from_metadata(&metadata()))
    }

    fn from_metadata(metadata: &Value) -> Self {
        let members: BTreeSet<&str> = array(&metadata["workspace_members"]).map(text).collect();
        let nodes: BTreeMap<&str, &Value> =
            array(&metadata["resolve"]["nodes"]).map(|n| (text(&n["id"]), n)).collect();
        let packages = array(&metadata["packages"]).filter_map(|p| {
            let id = text(&p["id"]);
            let folder = Path::new(text(&p["manifest_path"])).parent()?.to_owned();
            let package = Package {
                name: text(&p["name"]).to_owned(),
                version: text(&p["version"]).to_owned(),
                licence: p["license"].as_str().map(str::to_owned),
                folder,
                is_member: members.contains(id),
                dependencies: nodes.get(id).map(|n| linked(n)).unwrap_or_default(),
            };
            Some((id.to_owned(), package))
        });
        Self { packages: packages.collect() }
    }

    /// The packages of this repository.
    pub fn members(&self) -> impl Iterator<Item = &Package> {
        self.packages.values().filter(|p| p.is_member)
    }

    /// Names of everything that a package depends on, however far away.
    #[must_use]
    pub fn reach_of(&self, package: &Package) -> BTreeSet<&str> {
        let mut reached = BTreeSet::new();
        let mut open: Vec<&String> = package.dependencies.iter().collect();
        while let Some(id) = open.pop() {
            if reached.insert(id) {
                open.extend(&self.packages[id].dependencies);
            }
        }
        reached.into_iter().map(|id| self.packages[id].name.as_str()).collect()
    }
}

/// Ids behind the arrows of a node, without those that exist only for tests.
fn linked(node: &Value) -> BTreeSet<String> {
    let is_linked = |d: &&Value| array(&d["dep_kinds"]).any(|k| k["kind"] != "dev");
    array(&node["deps"]).filter(is_linked).map(|d| text(&d["pkg"]).to_owned()).collect()
}

fn metadata() -> Value {
    let host = run(Command::new("rustc").arg("-vV"));
    let host = host.lines().find_map(|l| l.strip_prefix("host: ")).expect("rustc names its host");
    let flags = ["metadata", "--format-version=1", "--locked", "--filter-platform", host];
    let output = run(Command::new(env!("CARGO")).args(flags).current_dir(root()));
    serde_json::from_str(&output).expect("cargo metadata is JSON")
}

/// What a command prints on stdout.
///
/// # Panics
/// When it cannot be started or fails.
pub fn run(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|e| panic!("cannot run {command:?}: {e}"));
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?} failed, {}:\n{errors}", output.status);
    String::from_utf8(output.stdout).expect("output is UTF-8")
}

fn array(value: &Value) -> impl Iterator<Item = &Value> {
    value.as_array().into_iter().flatten()
}

fn text(value: &Value) -> &str {
    value.as_str().expect("cargo metadata has a text here")
}
