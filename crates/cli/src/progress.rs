//! Progress on stderr: a bar on a terminal, a line now and then elsewhere, nothing when quiet.
//! Or, with `--progress openjd`, on stdout as the messages that Open Job Description defines:
//! `openjd_progress: PERCENT`, `openjd_status: TEXT`, `openjd_fail: TEXT`, each a line of its own.
//!
//! Log lines and the bar share stderr without tearing each other: both go through one
//! [`indicatif::MultiProgress`].

use std::io::{self, IsTerminal, Write};
use std::sync::LazyLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::ValueEnum;
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

use crate::report::{duration, thousands};

static BARS: LazyLock<MultiProgress> = LazyLock::new(MultiProgress::new);
static QUIET: AtomicBool = AtomicBool::new(false);
static OPENJD: AtomicBool = AtomicBool::new(false);

/// Shortest pause between the lines where there is no terminal, when there is something new.
const PLAIN_EVERY: Duration = Duration::from_secs(5);
/// Shortest pause between the messages for Open Job Description.
const OPENJD_EVERY: Duration = Duration::from_secs(1);
/// Longest pause between these lines: silence for a minute looks like a hang.
const PLAIN_AT_LEAST: Duration = Duration::from_secs(60);

/// How progress is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Style {
    /// A bar on a terminal, lines elsewhere.
    Auto,
    /// Messages of Open Job Description, on stdout.
    Openjd,
}

/// Sets how progress is written.
pub fn use_style(style: Style) {
    OPENJD.store(style == Style::Openjd, Ordering::Relaxed);
}

/// Says why the command failed, where someone reads messages of Open Job Description.
pub fn failed(line: &str) {
    if OPENJD.load(Ordering::Relaxed) {
        openjd("fail", line);
    }
}

/// A message of Open Job Description.
fn openjd(kind: &str, text: &str) {
    let mut stdout = io::stdout().lock();
    // Nothing sensible is left to do when stdout does not take the text.
    let _ = writeln!(stdout, "openjd_{kind}: {text}").and_then(|()| stdout.flush());
}

/// Switches progress and notes off.
pub fn be_quiet() {
    QUIET.store(true, Ordering::Relaxed);
}

/// A remark on stderr, above the bar; left out when quiet.
pub fn note(text: &str) {
    if !QUIET.load(Ordering::Relaxed) {
        always(text);
    }
}

/// A line on stderr even when quiet.
pub fn always(text: &str) {
    BARS.suspend(|| {
        // Nothing sensible is left to do when stderr does not take the text.
        let _ = writeln!(io::stderr(), "{text}");
    });
}

/// How far a command is.
pub struct Progress {
    bar: Option<ProgressBar>,
    what: &'static str,
    unit: &'static str,
    total: u64,
    started: Instant,
    /// When the last line was written, and the units that were done then.
    last_line: (Instant, u64),
    /// Where it stood when it began: a resumed bake does not count what was there.
    from: Option<u64>,
    /// False until the first message for Open Job Description.
    is_told: bool,
}

impl Progress {
    /// Progress towards `total` units, a noun in the plural.
    pub fn new(what: &'static str, unit: &'static str, total: u64) -> Self {
        let terminal = io::stderr().is_terminal()
            && !QUIET.load(Ordering::Relaxed)
            && !OPENJD.load(Ordering::Relaxed);
        let bar = terminal.then(|| {
            let template = "{prefix} [{bar:30}] {human_pos}/{human_len} {msg}";
            let style = ProgressStyle::with_template(template)
                .map_or_else(|_| ProgressStyle::default_bar(), |s| s.progress_chars("=> "));
            let bar = BARS.add(ProgressBar::new(total).with_style(style).with_prefix(what));
            bar.enable_steady_tick(Duration::from_millis(200));
            bar
        });
        let now = Instant::now();
        Self {
            bar,
            what,
            unit,
            total,
            started: now,
            last_line: (now, 0),
            from: None,
            is_told: false,
        }
    }

    /// Sets the number of finished units. `extra` is shown behind rate and remaining time.
    pub fn set(&mut self, done: u64, extra: &str) {
        let from = *self.from.get_or_insert(done);
        let (rate, left) = self.estimate(done - from.min(done), self.total.saturating_sub(done));
        let mut text = self.unit.to_owned();
        for part in [rate, left, extra.to_owned()] {
            if !part.is_empty() {
                text.push_str(", ");
                text.push_str(&part);
            }
        }
        if OPENJD.load(Ordering::Relaxed) {
            self.set_openjd(done, &text);
        } else if let Some(bar) = &self.bar {
            bar.set_position(done);
            bar.set_message(text);
        } else if self.line_is_due(done) {
            self.last_line = (Instant::now(), done);
            note(&format!("{} {}/{} {text}", self.what, thousands(done), thousands(self.total)));
        }
    }

    /// Progress and status: at first, at the end, and in between when there is something new.
    fn set_openjd(&mut self, done: u64, text: &str) {
        let is_due = self.last_line.0.elapsed() >= OPENJD_EVERY && done != self.last_line.1;
        if !self.is_told || done >= self.total || is_due {
            self.is_told = true;
            self.last_line = (Instant::now(), done);
            openjd("progress", &percent(done, self.total));
            let (done, total) = (thousands(done), thousands(self.total));
            openjd("status", &format!("{} {done}/{total} {text}", self.what));
        }
    }

    fn line_is_due(&self, done: u64) -> bool {
        let (since, before) = (self.last_line.0.elapsed(), self.last_line.1);
        since >= if done == before { PLAIN_AT_LEAST } else { PLAIN_EVERY }
    }

    /// Units a second since the start, and the time that is left at that rate.
    fn estimate(&self, made: u64, open: u64) -> (String, String) {
        let seconds = self.started.elapsed().as_secs_f64();
        if made == 0 || seconds <= 0.0 {
            return (String::new(), String::new());
        }
        let rate = made as f64 / seconds;
        let left = format!("{} left", duration(open as f64 / rate));
        (format!("{rate:.1}/s"), if open > 0 { left } else { String::new() })
    }
}

/// A share from 0 to 100, as Open Job Description wants it.
fn percent(done: u64, total: u64) -> String {
    let share = if total == 0 { 1.0 } else { (done as f64 / total as f64).min(1.0) };
    format!("{:.1}", share * 100.0)
}

/// The bar goes when its command is done with it, however that came.
impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// Where log lines go: stderr, above the bar.
pub struct LogWriter;

impl Write for LogWriter {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        BARS.suspend(|| io::stderr().write(line))
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentages_stay_between_0_and_100() {
        assert_eq!(percent(0, 3), "0.0");
        assert_eq!(percent(1, 3), "33.3");
        assert_eq!(percent(3, 3), "100.0");
        assert_eq!(percent(4, 3), "100.0");
        assert_eq!(percent(0, 0), "100.0", "there was nothing to do");
    }
}
