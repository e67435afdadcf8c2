//! What can go wrong, by what the user can do about it, and the exit code of each kind.
//!
//! | code | kind |
//! | --- | --- |
//! | 0 | success |
//! | 1 | the question was answered with no: a limit of `verify` is exceeded, no cell is there |
//! | 2 | the command line or the configuration is wrong |
//! | 3 | a scene or dataset is missing, damaged or refused |
//! | 4 | the output or the store does not work: rights, space, a store without safe commits |
//! | 5 | the bake ended with tasks missing; they are listed |
//! | 6 | a coordinator or worker cannot be reached; trying again may help |
//! | 70 | a defect of Sightline |
//! | 130 | interrupted; the same command resumes |
//!
//! Commands return a [`Failure`]; `main` prints it and exits with [`Kind::exit_code`]. Nobody
//! matches on messages.

use std::fmt;

use serde_json::json;
use sightline_coordinator::{CoordinatorError, PrepareError, SceneFilesError};
use sightline_jobs::ConfigError;
use sightline_scene::SceneError;
use sightline_scene::export::ExportError;
use sightline_scene::generate::GenerateError;
use sightline_store::{ErrorClass, StoreError};
use sightline_worker::WorkerError;

/// Kinds of failure; see the module for what each asks of the user.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The answer is no.
    Negative,
    /// Command line or configuration.
    Usage,
    /// Scene or dataset.
    Input,
    /// Output or store.
    Store,
    /// Tasks of the bake are missing.
    Incomplete,
    /// Coordinator or worker out of reach.
    Network,
    /// A defect.
    Defect,
    /// Ctrl-C.
    Interrupted,
}

impl Kind {
    const ALL: [Self; 8] = [
        Self::Negative,
        Self::Usage,
        Self::Input,
        Self::Store,
        Self::Incomplete,
        Self::Network,
        Self::Defect,
        Self::Interrupted,
    ];

    /// The exit code of the process.
    pub const fn exit_code(self) -> u8 {
        match self {
            Self::Negative => 1,
            Self::Usage => 2,
            Self::Input => 3,
            Self::Store => 4,
            Self::Incomplete => 5,
            Self::Network => 6,
            Self::Defect => 70,
            Self::Interrupted => 130,
        }
    }

    /// Name of the kind in JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Negative => "negative",
            Self::Usage => "usage",
            Self::Input => "input",
            Self::Store => "store",
            Self::Incomplete => "incomplete",
            Self::Network => "network",
            Self::Defect => "defect",
            Self::Interrupted => "interrupted",
        }
    }

    const fn meaning(self) -> &'static str {
        match self {
            Self::Negative => "the answer is no: an error limit is exceeded, no cell is there",
            Self::Usage => "the command line or the configuration is wrong",
            Self::Input => "a scene or dataset is missing, damaged or refused",
            Self::Store => "the output or the store does not work",
            Self::Incomplete => "the bake ended with tasks missing",
            Self::Network => "a coordinator or worker cannot be reached; try again",
            Self::Defect => "a defect of Sightline; please report it",
            Self::Interrupted => "interrupted; the same command resumes",
        }
    }
}

/// The table of exit codes, for `--help`.
pub fn exit_codes_help() -> String {
    let mut text = String::from("Exit codes:\n  0    success\n");
    for kind in Kind::ALL {
        text.push_str(&format!("  {:<4} {}\n", kind.exit_code(), kind.meaning()));
    }
    text
}

/// Why a command failed.
#[derive(Debug)]
pub struct Failure {
    /// What it asks of the user.
    pub kind: Kind,
    message: String,
    help: Option<String>,
}

/// Result of a command.
pub type Result<T, E = Failure> = std::result::Result<T, E>;

impl Failure {
    /// A failure with a message that says what happened.
    pub fn new(kind: Kind, message: impl Into<String>) -> Self {
        Self { kind, message: message.into(), help: None }
    }

    /// Adds what to do about it.
    #[must_use]
    pub fn with_help(mut self, help: impl Into<String>) -> Self {
        self.help = Some(help.into());
        self
    }

    /// A failure to read or write a file of the user.
    pub fn io(kind: Kind, what: &str, path: &std::path::Path, error: &std::io::Error) -> Self {
        Self::new(kind, format!("cannot {what} `{}`: {error}", path.display()))
    }

    /// The failure and what to do about it, on one line.
    pub fn to_line(&self) -> String {
        let parts = [Some(&self.message), self.help.as_ref()];
        let parts: Vec<&str> = parts.into_iter().flatten().map(String::as_str).collect();
        parts.join("; ").split_whitespace().collect::<Vec<_>>().join(" ")
    }

    /// The failure as a JSON value.
    pub fn to_json(&self) -> serde_json::Value {
        json!({ "error": {
            "kind": self.kind.name(),
            "exit_code": self.kind.exit_code(),
            "message": self.message,
            "help": self.help,
        }})
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Failure {}

impl miette::Diagnostic for Failure {
    fn help<'a>(&'a self) -> Option<Box<dyn fmt::Display + 'a>> {
        self.help.as_ref().map(|h| Box::new(h) as Box<dyn fmt::Display>)
    }
}

impl From<SceneError> for Failure {
    fn from(error: SceneError) -> Self {
        let failure = Self::new(Kind::Input, error.to_string());
        match error.help() {
            Some(help) => failure.with_help(help),
            None => failure,
        }
    }
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Self {
        let help = match &error {
            ConfigError::UnknownKey { .. } => "`sightline bake --help` documents every key",
            ConfigError::Syntax { .. } => "the configuration is a TOML file; see https://toml.io",
            ConfigError::WrongType { .. } | ConfigError::Invalid { .. } => {
                "`sightline bake --help` documents every key with its type and default"
            }
        };
        Self::new(Kind::Usage, error.to_string()).with_help(help)
    }
}

impl From<StoreError> for Failure {
    fn from(error: StoreError) -> Self {
        let (kind, help) = match (&error, error.class()) {
            (StoreError::NotADataset { .. }, _) => {
                (Kind::Input, "give the folder that `sightline bake --out` wrote")
            }
            (StoreError::BadLocation { .. }, _) => {
                (Kind::Input, "give a folder or a bucket that exists and that this user can use")
            }
            (StoreError::UnsupportedVersion { .. }, _) => {
                (Kind::Input, "use the version of Sightline that wrote it, or bake again")
            }
            (StoreError::Cache { .. }, _) => {
                (Kind::Store, "--cache and --cache-size say where copies are kept, and how much")
            }
            (StoreError::SourceFile { .. }, _) => (Kind::Input, "check the file and try again"),
            (StoreError::UnsafeStore { .. }, _) => {
                (Kind::Store, "give another place with --out; nothing was written there")
            }
            (_, ErrorClass::RetryLater) => (Kind::Store, "run the command again"),
            (_, ErrorClass::FixInput) => {
                (Kind::Store, "check the rights and the free space of the location")
            }
            (_, ErrorClass::Corrupt | ErrorClass::NotFound) => {
                (Kind::Input, "restore the file from a copy, or bake into a new folder")
            }
        };
        Self::new(kind, error.to_string()).with_help(help)
    }
}

impl From<GenerateError> for Failure {
    fn from(error: GenerateError) -> Self {
        match &error {
            GenerateError::Size { .. } => Self::new(Kind::Usage, error.to_string())
                .with_help("give --triangles in that range"),
            GenerateError::Spheres { .. } => {
                Self::new(Kind::Usage, error.to_string()).with_help("give --count in that range")
            }
            GenerateError::States { .. } => {
                Self::new(Kind::Usage, error.to_string()).with_help("give --states in that range")
            }
            GenerateError::Table(source) => Self::new(Kind::Store, format!("{error}: {source}"))
                .with_help("check the rights and the free space of the folder"),
            GenerateError::Write(source) => Self::new(Kind::Store, format!("{error}: {source}"))
                .with_help("check the rights and the free space of the folder"),
        }
    }
}

impl From<ExportError> for Failure {
    fn from(error: ExportError) -> Self {
        let text = error.to_string();
        match error {
            ExportError::Source(error) => error.into(),
            ExportError::SourceChanged { .. } => Self::new(Kind::Input, text)
                .with_help("run the command again; bake again when the scene has changed for good"),
            ExportError::NotThisScene { .. } => {
                Self::new(Kind::Input, text).with_help("the dataset is damaged; bake again")
            }
            ExportError::ReplacesSource { .. } => {
                Self::new(Kind::Usage, text).with_help("give another file with -o")
            }
            ExportError::Write { source, .. } => {
                Self::new(Kind::Store, format!("{text}: {source}"))
                    .with_help("check that the folder exists, its rights and its free space")
            }
            _ => Self::new(Kind::Input, text),
        }
    }
}

impl From<PrepareError> for Failure {
    fn from(error: PrepareError) -> Self {
        match error {
            PrepareError::Config(error) => error.into(),
            PrepareError::Scene(error) => error.into(),
            PrepareError::Region(_) => Self::new(Kind::Usage, error.to_string())
                .with_help("`sightline bake --help` documents the keys of the region"),
            PrepareError::NoCells { .. } => Self::new(Kind::Usage, error.to_string()).with_help(
                "`sightline info` shows the box of a scene and the names of its objects",
            ),
        }
    }
}

impl From<SceneFilesError> for Failure {
    fn from(error: SceneFilesError) -> Self {
        match error {
            SceneFilesError::Store(error) => error.into(),
            SceneFilesError::Scene(error) => error.into(),
            _ => Self::new(Kind::Input, error.to_string()),
        }
    }
}

impl From<CoordinatorError> for Failure {
    fn from(error: CoordinatorError) -> Self {
        let text = error.to_string();
        match error {
            CoordinatorError::Store(error) => error.into(),
            CoordinatorError::Listen { .. } | CoordinatorError::Security(_) => {
                Self::new(Kind::Usage, text)
            }
            CoordinatorError::PlanDiffers { .. } | CoordinatorError::DamagedState { .. } => {
                Self::new(Kind::Input, text)
            }
            CoordinatorError::Superseded { .. } => Self::new(Kind::Network, text)
                .with_help("let the newer coordinator finish, or stop it and start this one again"),
            CoordinatorError::Missing(_) => Self::new(Kind::Incomplete, text)
                .with_help("what is done is kept: the same command tries the missing tasks again"),
            CoordinatorError::NoWorkers { .. } => Self::new(Kind::Network, text),
            CoordinatorError::Stopped => Self::new(Kind::Interrupted, "stopped before the end")
                .with_help("what is done is kept: the same command resumes the bake"),
            _ => Self::new(Kind::Defect, text),
        }
    }
}

impl From<WorkerError> for Failure {
    fn from(error: WorkerError) -> Self {
        let text = error.to_string();
        match error {
            WorkerError::Store(error) => error.into(),
            WorkerError::Scene(error) => error.into(),
            WorkerError::BadUrl { .. }
            | WorkerError::Threads { .. }
            | WorkerError::Credentials(_) => Self::new(Kind::Usage, text),
            WorkerError::NoScene { .. }
            | WorkerError::OtherScene { .. }
            | WorkerError::OtherStates { .. }
            | WorkerError::Plan { .. } => Self::new(Kind::Input, text),
            WorkerError::Unreachable { .. } => Self::new(Kind::Network, text),
            WorkerError::Refused(_) => Self::new(Kind::Network, text)
                .with_help("run the same version of Sightline as the coordinator"),
            _ => Self::new(Kind::Defect, text),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_has_its_own_code_and_is_documented() {
        let help = exit_codes_help();
        let codes: std::collections::BTreeSet<u8> =
            Kind::ALL.iter().map(|k| k.exit_code()).collect();
        assert_eq!(codes.len(), Kind::ALL.len());
        assert!(codes.iter().all(|c| help.contains(&format!("\n  {c:<4} "))));
    }
}
