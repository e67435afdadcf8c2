//! Commands that a test starts: their output in files, an end within a time limit, and no process
//! that outlives its test.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

/// How often a condition is looked at.
const POLL: Duration = Duration::from_millis(10);

/// A running command; killed by its id when dropped.
pub struct Process {
    child: Child,
    name: String,
    stdout: PathBuf,
    stderr: PathBuf,
}

/// How a command ended.
#[derive(Debug)]
pub struct Ended {
    /// Exit status.
    pub status: ExitStatus,
    /// Everything on stdout.
    pub stdout: String,
    /// Everything on stderr.
    pub stderr: String,
    /// The command line, for messages.
    pub name: String,
}

impl Process {
    /// Starts `command`; its output goes to files of `folder` that begin with `name`.
    ///
    /// # Panics
    /// When it cannot be started.
    #[must_use]
    pub fn start(command: &mut Command, folder: &Path, name: &str) -> Self {
        let stdout = folder.join(format!("{name}.stdout"));
        let stderr = folder.join(format!("{name}.stderr"));
        let file = |p: &Path| File::create(p).unwrap_or_else(|e| panic!("{}: {e}", p.display()));
        let child = command
            .stdin(Stdio::null())
            .stdout(file(&stdout))
            .stderr(file(&stderr))
            .spawn()
            .unwrap_or_else(|e| panic!("cannot start {command:?}: {e}"));
        Self { child, name: format!("{command:?}"), stdout, stderr }
    }

    /// True until the process ends.
    ///
    /// # Panics
    /// When the system cannot tell.
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().expect("the state of a child can be read").is_none()
    }

    /// The number of the process.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// What the process has written to stderr so far.
    #[must_use]
    pub fn stderr(&self) -> String {
        lossy(&self.stderr)
    }

    /// SIGKILL: the process has no say in it.
    ///
    /// # Panics
    /// When the process has ended by itself.
    pub fn kill(mut self) {
        assert!(self.is_running(), "{} ended before it was killed:\n{}", self.name, self.stderr());
        self.child.kill().expect("a running child can be killed");
        self.child.wait().expect("a killed child ends");
    }

    /// SIGINT, as Ctrl-C sends it.
    ///
    /// # Panics
    /// When the process has ended by itself.
    pub fn interrupt(&mut self) {
        assert!(self.is_running(), "{} ended before Ctrl-C:\n{}", self.name, self.stderr());
        self.signal("INT");
    }

    /// Sends a signal by its name, such as `TERM`. Nothing happens when the process has ended.
    ///
    /// # Panics
    /// When a running process does not take it.
    pub fn signal(&mut self, name: &str) {
        if !self.is_running() {
            return;
        }
        // `kill` of the shell, since the standard library sends only SIGKILL. The process is not
        // waited for yet, so its number belongs to nobody else.
        let kill = format!("kill -{name} {}", self.child.id());
        let status = Command::new("sh").args(["-c", &kill]).status().expect("sh runs");
        assert!(status.success(), "{kill} failed");
    }

    /// Waits for the end of the process.
    ///
    /// # Panics
    /// When it takes longer than `limit`; the process is killed then.
    pub fn wait(mut self, limit: Duration) -> Ended {
        let ended = eventually(limit, || !self.is_running());
        assert!(ended, "{} runs longer than {limit:?}:\n{}", self.name, self.stderr());
        let status = self.child.wait().expect("a child that ended has a status");
        let (stdout, stderr) = (lossy(&self.stdout), lossy(&self.stderr));
        Ended { status, stdout, stderr, name: self.name.clone() }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Both fail when the process has ended, and then nothing is left to do.
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            let text = format!("--- stderr of {}\n{}\n", self.name, self.stderr());
            let _ = std::io::stderr().write_all(text.as_bytes());
        }
    }
}

impl Ended {
    /// The end of a command that succeeded.
    ///
    /// # Panics
    /// When it failed, with its output.
    #[must_use]
    pub fn success(self) -> Self {
        assert!(self.status.success(), "{self:#?}");
        self
    }

    /// The end of a command that failed with this exit code.
    ///
    /// # Panics
    /// When it ended otherwise, with its output.
    #[must_use]
    pub fn failure(self, exit_code: i32) -> Self {
        assert_eq!(self.status.code(), Some(exit_code), "{self:#?}");
        self
    }

    /// The JSON object on stdout.
    ///
    /// # Panics
    /// When stdout is something else.
    #[must_use]
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.stdout).unwrap_or_else(|e| panic!("no JSON, {e}: {self:#?}"))
    }
}

/// Looks at a condition until it holds; false when `limit` has passed.
#[expect(clippy::disallowed_methods, reason = "a test has no event to wait for in another process")]
pub fn eventually(limit: Duration, mut condition: impl FnMut() -> bool) -> bool {
    let start = Instant::now();
    loop {
        if condition() {
            return true;
        }
        if start.elapsed() > limit {
            return false;
        }
        std::thread::sleep(POLL);
    }
}

/// Runs a command to its end within `limit`.
#[must_use]
pub fn run(command: &mut Command, limit: Duration) -> Ended {
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    Process::start(command, folder.path(), "run").wait(limit)
}

fn lossy(path: &Path) -> String {
    String::from_utf8_lossy(&std::fs::read(path).unwrap_or_default()).into_owned()
}
