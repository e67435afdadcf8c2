//! Errors of the store, by what the caller has to do about them.
//!
//! [`StoreError::class`] is the contract: callers decide on the class, people read the message.
//! Nobody matches on strings.

/// Result of a store operation.
pub type Result<T, E = StoreError> = std::result::Result<T, E>;

/// What the caller has to do about a [`StoreError`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorClass {
    /// The store did not answer as it should; the same call may succeed later.
    RetryLater,
    /// The location, the rights or the rows handed in are wrong; trying again changes nothing.
    FixInput,
    /// Stored bytes are not what was written; restore or bake again.
    Corrupt,
    /// There is no such object.
    NotFound,
}

/// Why a store operation failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StoreError {
    /// The store failed in a way that may pass.
    #[error("the store did not complete a request for `{key}`: {source}")]
    Unavailable {
        /// Key of the object, relative to the store's location.
        key: String,
        /// What the backend reported.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The store refused: missing rights, read-only, or an operation it does not offer.
    #[error("the store refused a request for `{key}`: {source}")]
    Refused {
        /// Key of the object, relative to the store's location.
        key: String,
        /// What the backend reported.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// There is no such object.
    #[error("`{key}` does not exist in {location}")]
    NotFound {
        /// Key of the object, relative to the store's location.
        key: String,
        /// The store.
        location: String,
    },
    /// A stored object is damaged.
    #[error("`{file}` is damaged: {problem}")]
    Corrupt {
        /// Key of the object, relative to the store's location.
        file: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The location cannot be used as a store.
    #[error("`{location}` cannot be used as a store: {problem}")]
    BadLocation {
        /// The location as given.
        location: String,
        /// What is wrong with it.
        problem: String,
    },
    /// A file of this machine, on its way to or from the store, cannot be used.
    #[error("`{path}` cannot be used: {problem}", path = .path.display())]
    SourceFile {
        /// The file.
        path: std::path::PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// The folder that keeps copies of objects cannot be used.
    #[error("the cache {path} cannot be used: {problem}", path = .path.display())]
    Cache {
        /// The folder.
        path: std::path::PathBuf,
        /// What is wrong with it, and what to do.
        problem: String,
    },
    /// The store does not keep the promise that commits rest on.
    #[error(
        "{location} cannot hold a bake: {problem}. Use a local file system with hard links, or an \
         object store with conditional writes"
    )]
    UnsafeStore {
        /// The store.
        location: String,
        /// Which promise it broke.
        problem: String,
    },
    /// The location holds no published dataset.
    #[error("{location} is not a Sightline dataset: {problem}")]
    NotADataset {
        /// The store.
        location: String,
        /// What is missing.
        problem: String,
    },
    /// The file was written in a version of its format that this program does not know.
    #[error("`{file}` is version {found} of its format; this program reads version {supported}")]
    UnsupportedVersion {
        /// Key of the object, relative to the store's location.
        file: String,
        /// The version in the file.
        found: u64,
        /// The version that this program reads.
        supported: u32,
    },
    /// Rows or descriptions handed to a writer break its contract.
    #[error("rows break the contract of {table}: {problem}")]
    InvalidRows {
        /// The table they were meant for.
        table: &'static str,
        /// The broken rule.
        problem: String,
    },
}

impl StoreError {
    /// What the caller has to do about it.
    #[must_use]
    pub const fn class(&self) -> ErrorClass {
        match self {
            Self::Unavailable { .. } => ErrorClass::RetryLater,
            Self::NotFound { .. } => ErrorClass::NotFound,
            Self::Corrupt { .. } => ErrorClass::Corrupt,
            Self::Refused { .. }
            | Self::BadLocation { .. }
            | Self::SourceFile { .. }
            | Self::Cache { .. }
            | Self::UnsafeStore { .. }
            | Self::NotADataset { .. }
            | Self::UnsupportedVersion { .. }
            | Self::InvalidRows { .. } => ErrorClass::FixInput,
        }
    }

    pub(crate) fn corrupt(file: &str, problem: impl std::fmt::Display) -> Self {
        Self::Corrupt { file: file.to_owned(), problem: problem.to_string() }
    }
}
