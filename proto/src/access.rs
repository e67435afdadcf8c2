//! Who may call what: the words of access control that both sides of the protocol use.
//!
//! A caller has roles. A *worker* leases tasks and reports on them, and does nothing else; a
//! *viewer* looks at the status. Roles come from a client certificate, which names them as URIs
//! among its subject's alternative names ([`Role::uri`]), or from a bearer token, which stands in a
//! token file:
//!
//! ```text
//! # comments and empty lines are left out
//! worker: 4f1c9b2e8d7a6053c1e8
//! viewer: 90ab12cd34ef56ab78cd
//! 0d6e5f4c3b2a19080706         a line without a role: both
//! ```
//!
//! Promises:
//! - [`rule_of`] knows every method; a path that it does not know needs a role, like all others.
//! - No secret is in an error, a log line or the output of `Debug`.
//! - A token file is read again when it changes, so that tokens can be replaced while a bake runs.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

/// Shortest token, bytes: a guess should not be worth trying.
pub const TOKEN_BYTES_MIN: usize = 16;
/// Longest token, bytes.
pub const TOKEN_BYTES_MAX: usize = 512;
/// Largest token file, bytes.
const FILE_BYTES_MAX: u64 = 1 << 20;
/// Shortest time between two looks at whether a token file has changed.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// What a caller may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Leases tasks and reports on them.
    Worker,
    /// Looks at the status.
    Viewer,
}

impl Role {
    /// Every role.
    pub const ALL: [Self; 2] = [Self::Worker, Self::Viewer];

    /// The name in a token file.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Worker => "worker",
            Self::Viewer => "viewer",
        }
    }

    /// The URI in a client certificate.
    #[must_use]
    pub const fn uri(self) -> &'static str {
        match self {
            Self::Worker => "urn:sightline:role:worker",
            Self::Viewer => "urn:sightline:role:viewer",
        }
    }
}

/// A set of roles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Roles {
    worker: bool,
    viewer: bool,
}

impl Roles {
    /// Every role.
    pub const ALL: Self = Self { worker: true, viewer: true };

    /// The roles that a certificate's URIs name.
    pub fn of_uris<'a>(uris: impl IntoIterator<Item = &'a str>) -> Self {
        let mut roles = Self::default();
        for uri in uris {
            for role in Role::ALL.into_iter().filter(|role| role.uri() == uri) {
                roles = roles.with(role);
            }
        }
        roles
    }

    /// These and one more.
    #[must_use]
    pub const fn with(self, role: Role) -> Self {
        match role {
            Role::Worker => Self { worker: true, ..self },
            Role::Viewer => Self { viewer: true, ..self },
        }
    }

    /// True when the role is among them.
    #[must_use]
    pub const fn has(self, role: Role) -> bool {
        match role {
            Role::Worker => self.worker,
            Role::Viewer => self.viewer,
        }
    }

    /// Those that are in both.
    #[must_use]
    pub const fn and(self, other: Self) -> Self {
        Self { worker: self.worker && other.worker, viewer: self.viewer && other.viewer }
    }

    /// Those that are in either.
    #[must_use]
    pub const fn or(self, other: Self) -> Self {
        Self { worker: self.worker || other.worker, viewer: self.viewer || other.viewer }
    }

    /// True when a method with this rule may be called.
    #[must_use]
    pub const fn allow(self, rule: Rule) -> bool {
        match rule {
            Rule::Open => true,
            Rule::Any => self.worker || self.viewer,
            Rule::Only(role) => self.has(role),
        }
    }
}

/// Who may call a method.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rule {
    /// Everyone who can connect.
    Open,
    /// Everyone with a role.
    Any,
    /// This role.
    Only(Role),
}

/// The rule of a gRPC method, `/package.Service/Method`.
#[must_use]
pub fn rule_of(path: &str) -> Rule {
    let Some((service, method)) = path.strip_prefix('/').and_then(|p| p.split_once('/')) else {
        return Rule::Any;
    };
    match (service, method) {
        ("grpc.health.v1.Health", _) => Rule::Open,
        ("sightline.v1.Coordinator", "Register" | "Lease" | "Heartbeat" | "Report" | "Goodbye") => {
            Rule::Only(Role::Worker)
        }
        // KEDA looks at the bake to decide how many workers to run.
        ("sightline.v1.Coordinator", "GetStatus" | "WatchStatus")
        | ("externalscaler.ExternalScaler", _) => Rule::Only(Role::Viewer),
        _ => Rule::Any,
    }
}

/// A bearer token. `Debug` does not show it.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl Token {
    /// The token itself: for a header, or for its hash. Not for messages.
    #[must_use]
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(..)")
    }
}

/// What is wrong with a token file. Says where, never what stands there.
#[derive(Debug, thiserror::Error)]
pub enum TokenFileError {
    /// The file cannot be read.
    #[error("the token file {path} cannot be read: {source}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A line is not a token.
    #[error(
        "{path}, line {line}: {problem}; write `worker: TOKEN`, `viewer: TOKEN`, or the token alone \
         for both", path = path.display()
    )]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        problem: String,
    },
    /// There is no token for what is asked of the file.
    #[error("the token file {path} has no token of a {role}", path = path.display())]
    NoToken {
        /// The file.
        path: PathBuf,
        /// Whose token is looked for.
        role: &'static str,
    },
}

/// The tokens of a file's text. `path` is for messages.
///
/// # Errors
/// [`TokenFileError::Line`] with the first line that is none, and when there is no token at all.
pub fn parse_tokens(path: &Path, text: &str) -> Result<Vec<(Roles, Token)>, TokenFileError> {
    let mut tokens = Vec::new();
    for (line, content) in (1..).zip(text.lines()) {
        let content = content.trim();
        if content.is_empty() || content.starts_with('#') {
            continue;
        }
        let bad = |problem: String| TokenFileError::Line { path: path.to_owned(), line, problem };
        let (roles, token) = match content.split_once(':') {
            None => (Roles::ALL, content),
            Some((name, token)) => {
                let role = Role::ALL.into_iter().find(|role| role.name() == name.trim());
                let role = role.ok_or_else(|| bad("there is no such role".into()))?;
                (Roles::default().with(role), token.trim())
            }
        };
        if !(TOKEN_BYTES_MIN..=TOKEN_BYTES_MAX).contains(&token.len()) {
            let size = token.len();
            return Err(bad(format!(
                "a token has {TOKEN_BYTES_MIN} to {TOKEN_BYTES_MAX} bytes, this one {size}"
            )));
        }
        if !token.bytes().all(|b| b.is_ascii_graphic()) {
            return Err(
                bad("a token is letters, digits and signs of ASCII, without spaces".into()),
            );
        }
        tokens.push((roles, Token(token.to_owned())));
    }
    if tokens.is_empty() {
        return Err(TokenFileError::NoToken { path: path.to_owned(), role: "worker or viewer" });
    }
    Ok(tokens)
}

/// What a token file is read for: from its path, for messages, and its tokens.
pub type Make<T> = fn(&Path, Vec<(Roles, Token)>) -> Result<T, TokenFileError>;

/// Tells versions of a file apart.
type Stamp = (Option<SystemTime>, u64);

#[derive(Debug)]
struct Read<T> {
    looked: Instant,
    stamp: Stamp,
    content: Arc<T>,
}

/// A token file, and what was made of its tokens. Read again when it changes; a file that cannot
/// be used any more leaves what was there before.
pub struct TokenFile<T> {
    path: PathBuf,
    make: Make<T>,
    read: Mutex<Read<T>>,
}

impl<T> fmt::Debug for TokenFile<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TokenFile").field("path", &self.path).finish_non_exhaustive()
    }
}

impl<T> TokenFile<T> {
    /// Reads the file; `make` turns its tokens into what is asked of it.
    ///
    /// # Errors
    /// When the file cannot be read or used.
    pub fn open(path: &Path, make: Make<T>) -> Result<Self, TokenFileError> {
        let (stamp, content) = read_file(path, make)?;
        let read = Read { looked: Instant::now(), stamp, content: Arc::new(content) };
        Ok(Self { path: path.to_owned(), make, read: Mutex::new(read) })
    }

    /// What was made of the file, as it is now.
    pub fn get(&self) -> Arc<T> {
        // A panic while it is held leaves what was read before.
        let mut read = self.read.lock().unwrap_or_else(PoisonError::into_inner);
        if read.looked.elapsed() >= LOOK_EVERY {
            read.looked = Instant::now();
            if stamp_of(&self.path).ok() != Some(read.stamp) {
                match read_file(&self.path, self.make) {
                    Ok((stamp, content)) => {
                        tracing::info!(file = %self.path.display(), "the token file was read again");
                        (read.stamp, read.content) = (stamp, Arc::new(content));
                    }
                    Err(error) => tracing::warn!(%error, "the tokens read before stay in use"),
                }
            }
        }
        Arc::clone(&read.content)
    }
}

fn stamp_of(path: &Path) -> std::io::Result<Stamp> {
    let found = std::fs::metadata(path)?;
    Ok((found.modified().ok(), found.len()))
}

fn read_file<T>(path: &Path, make: Make<T>) -> Result<(Stamp, T), TokenFileError> {
    let failed = |source| TokenFileError::Read { path: path.to_owned(), source };
    // The stamp comes first: a change while reading is seen at the next look.
    let stamp = stamp_of(path).map_err(failed)?;
    if stamp.1 > FILE_BYTES_MAX {
        return Err(failed(std::io::Error::other("it is too large to be one")));
    }
    let text = std::fs::read_to_string(path).map_err(failed)?;
    Ok((stamp, make(path, parse_tokens(path, &text)?)?))
}

/// The first token of a file that gives `role`.
///
/// # Errors
/// [`TokenFileError::NoToken`] when there is none.
pub fn token_for(
    role: Role,
    path: &Path,
    tokens: Vec<(Roles, Token)>,
) -> Result<Token, TokenFileError> {
    let found = tokens.into_iter().find(|(roles, _)| roles.has(role)).map(|(_, token)| token);
    found.ok_or_else(|| TokenFileError::NoToken { path: path.to_owned(), role: role.name() })
}

#[cfg(test)]
mod tests {
    use prost::Message;

    use super::*;

    const WORKER: &str = "0123456789abcdef-w";
    const VIEWER: &str = "0123456789abcdef-v";

    fn parse(text: &str) -> Result<Vec<(Roles, Token)>, TokenFileError> {
        parse_tokens(Path::new("tokens"), text)
    }

    #[test]
    fn a_token_file_gives_roles() {
        let text = format!("# ours\n\nworker: {WORKER}\n viewer:{VIEWER} \n0123456789abcdef\n");
        let tokens = parse(&text).unwrap();
        let roles: Vec<Roles> = tokens.iter().map(|(roles, _)| *roles).collect();
        let (worker, viewer) =
            (Roles::default().with(Role::Worker), Roles::default().with(Role::Viewer));
        assert_eq!(roles, [worker, viewer, Roles::ALL]);
        let of = |role| token_for(role, Path::new("tokens"), tokens.clone()).unwrap();
        assert_eq!((of(Role::Worker).reveal(), of(Role::Viewer).reveal()), (WORKER, VIEWER));
    }

    #[test]
    fn a_bad_line_is_named_and_not_shown() {
        for text in ["boss: 0123456789abcdef", "worker: short-secret", "0123456789abcde\u{e9}f-x"] {
            let error = parse(&format!("\n{text}")).unwrap_err();
            let message = format!("{error} {error:?}");
            assert!(error.to_string().contains("line 2"), "{error}");
            assert!(!message.contains("secret") && !message.contains("89abc"), "{message}");
        }
        assert!(matches!(parse("# nothing\n"), Err(TokenFileError::NoToken { .. })));
    }

    #[test]
    fn secrets_are_not_debugged() {
        assert!(!format!("{:?}", parse(WORKER).unwrap()).contains(WORKER));
    }

    #[test]
    fn a_changed_file_is_read_again_and_a_broken_one_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens");
        std::fs::write(&path, WORKER).unwrap();
        let file = TokenFile::open(&path, |_, tokens| Ok(tokens)).unwrap();
        let reads = |text: &str| {
            std::fs::write(&path, text).unwrap();
            file.read.lock().unwrap().looked = Instant::now().checked_sub(LOOK_EVERY).unwrap();
            file.get()[0].1.reveal().to_owned()
        };
        assert_eq!(reads("0123456789abcdef-new"), "0123456789abcdef-new");
        assert_eq!(reads("oops"), "0123456789abcdef-new");
    }

    #[test]
    fn every_method_of_the_protocol_has_a_rule_of_its_own() {
        let set = prost_types::FileDescriptorSet::decode(crate::v1::FILE_DESCRIPTOR_SET).unwrap();
        let mut methods = 0;
        for file in &set.file {
            for service in &file.service {
                for method in &service.method {
                    let path = format!("/{}.{}/{}", file.package(), service.name(), method.name());
                    assert!(matches!(rule_of(&path), Rule::Only(_)), "{path}");
                    methods += 1;
                }
            }
        }
        assert!(methods >= 7);
        assert_eq!(rule_of("/grpc.health.v1.Health/Check"), Rule::Open);
        for path in ["", "/", "nothing", "/a.B/C", "/grpc.reflection.v1.ServerReflection/X"] {
            assert_eq!(rule_of(path), Rule::Any, "{path}");
        }
    }

    #[test]
    fn a_worker_does_not_look_and_a_viewer_does_not_lease() {
        let worker = Roles::of_uris([Role::Worker.uri(), "urn:other"]);
        assert!(worker.allow(Rule::Only(Role::Worker)) && !worker.allow(Rule::Only(Role::Viewer)));
        let none = Roles::of_uris(["urn:sightline:role:boss"]);
        assert!(!none.allow(Rule::Any) && none.allow(Rule::Open));
        assert_eq!(worker.and(Roles::default().with(Role::Viewer)), Roles::default());
    }
}
