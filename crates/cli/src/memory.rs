//! Time and peak memory of the phases of a command.
//!
//! The peak is the kernel's VmHWM of this process. Where the kernel lets a process reset it
//! (`/proc/self/clear_refs`), each phase has a peak of its own; elsewhere the peaks include
//! everything before, and say so. Without `/proc` there are no peaks.

use std::time::Instant;

use serde_json::{Value, json};

use sightline_scene::{Held, Keeper};

use crate::report::{Table, bytes, duration, thousands};

/// One finished phase.
struct Phase {
    name: &'static str,
    seconds: f64,
    peak_bytes: Option<u64>,
}

/// The phases of a command, one after the other.
pub struct Phases {
    done: Vec<Phase>,
    current: Option<(&'static str, Instant)>,
    /// True while every reset succeeded.
    separate: bool,
}

impl Phases {
    /// Starts the first phase.
    pub fn start(name: &'static str) -> Self {
        let mut phases = Self { done: Vec::new(), current: None, separate: true };
        phases.next(name);
        phases
    }

    /// Ends the current phase and starts another.
    pub fn next(&mut self, name: &'static str) {
        self.finish();
        // "5" resets the peak to the present size: see proc_pid_clear_refs(5).
        self.separate &= std::fs::write("/proc/self/clear_refs", "5").is_ok();
        self.current = Some((name, Instant::now()));
    }

    /// Ends the current phase.
    pub fn finish(&mut self) {
        if let Some((name, since)) = self.current.take() {
            let seconds = since.elapsed().as_secs_f64();
            self.done.push(Phase { name, seconds, peak_bytes: peak_bytes() });
        }
    }

    /// Seconds of all finished phases.
    pub fn total_seconds(&self) -> f64 {
        self.done.iter().map(|p| p.seconds).sum()
    }

    /// Adds a row a phase.
    pub fn add_to(&self, table: &mut Table) {
        let note = if self.separate { "" } else { " so far" };
        for phase in &self.done {
            let peak =
                phase.peak_bytes.map_or(String::new(), |p| format!(", peak {}{note}", bytes(p)));
            table.row(phase.name, format!("{}{peak}", duration(phase.seconds)));
        }
        table.row("total", duration(self.total_seconds()));
    }

    /// The phases as JSON.
    pub fn to_json(&self) -> Value {
        let phases: Vec<Value> = self
            .done
            .iter()
            .map(|p| json!({ "name": p.name, "seconds": p.seconds, "peak_bytes": p.peak_bytes }))
            .collect();
        json!({ "phases": phases, "peaks_are_cumulative": !self.separate })
    }
}

/// Adds rows on what was held of a scene in chunks.
pub fn add_held(table: &mut Table, held: &Held) {
    let Held { limit, bytes: size, chunks, touched, loaded, given_back, overruns } = *held;
    table.row("memory limit", bytes(limit)).row(
        "chunks",
        format!(
            "{} ({}), {} never touched, {} loaded, {} given back",
            thousands(chunks),
            bytes(size),
            thousands(chunks - touched),
            thousands(loaded),
            thousands(given_back),
        ),
    );
    if overruns > 0 {
        table.row(
            "above the limit",
            format!("{} times, with nothing to give back", thousands(overruns)),
        );
    }
}

/// The same as JSON; null without a limit.
pub fn held_json(keeper: Option<&Keeper>) -> Value {
    let Some(held) = keeper.map(Keeper::held) else { return Value::Null };
    json!({
        "limit_bytes": held.limit,
        "chunk_file_bytes": held.bytes,
        "chunks": held.chunks,
        "chunks_touched": held.touched,
        "chunks_loaded": held.loaded,
        "chunks_given_back": held.given_back,
        "overruns": held.overruns,
    })
}

/// Peak resident memory of this process, bytes.
fn peak_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib * 1024)
}
