//! `sightline status`: how a bake is doing, from its coordinator, or from what is stored.

use std::io::IsTerminal;
use std::time::Duration;

use serde_json::{Value, json};
use sightline_jobs::{BakeStatus, Done, LeaseStatus, Phase, TaskId};
use sightline_proto::access::Role;
use sightline_proto::v1;
use sightline_worker::security::Client;

use super::signalled;
use super::stored::Stored;
use crate::arguments::Status as Command;
use crate::failure::{Failure, Kind, Result};
use crate::report::{Table, count, duration, print, print_json, thousands};

/// Entries of a list for people; JSON has them all.
const SHOWN_MAX: usize = 8;
/// Longest reason for people, characters.
const REASON_MAX: usize = 160;
/// How long a coordinator that went away is looked for while watching.
const RETRY_EVERY: Duration = Duration::from_secs(1);
const RETRIES_MAX: u32 = 30;

pub fn run(command: &Command) -> Result<()> {
    let is_url = ["http://", "https://"].iter().any(|scheme| command.of.starts_with(scheme));
    super::runtime()?.block_on(async {
        if !is_url {
            return show_stored(command).await;
        }
        let client = command.security.client(&command.of, Role::Viewer)?;
        let is_live = std::io::stdout().is_terminal() && !command.json;
        if command.watch || (is_live && !command.once) {
            return watch(client, command, is_live).await;
        }
        let status = get(client, &command.of).await?;
        show(&status, command.json);
        Ok(())
    })
}

async fn show_stored(command: &Command) -> Result<()> {
    if command.watch {
        return Err(Failure::new(Kind::Usage, "--watch needs the URL of a coordinator")
            .with_help("leave it out to see what is stored"));
    }
    let stored = Stored::read(&command.of).await?;
    if command.json {
        print_json(&stored.to_json());
    } else {
        print(&stored.to_text());
    }
    Ok(())
}

async fn get(mut client: Client, url: &str) -> Result<BakeStatus> {
    let answer = client.get_status(v1::GetStatusRequest {}).await;
    read(answer.map_err(|status| failure(url, &status))?.into_inner())
}

fn read(message: v1::Status) -> Result<BakeStatus> {
    BakeStatus::try_from(message).map_err(|error| {
        Failure::new(Kind::Network, format!("the coordinator's status cannot be read: {error}"))
            .with_help("run the same version of Sightline as the coordinator")
    })
}

fn failure(url: &str, status: &tonic::Status) -> Failure {
    use tonic::Code::{PermissionDenied, Unauthenticated};
    let (kind, help) = match status.code() {
        Unauthenticated => (Kind::Usage, "give --token-file, or --tls-cert and --tls-key"),
        PermissionDenied => (Kind::Usage, "the status is for callers with the role `viewer`"),
        _ => {
            (Kind::Network, "check that a coordinator runs there, and --tls-ca if it asks for TLS")
        }
    };
    let told = sightline_worker::security::told(status);
    Failure::new(kind, format!("{url} does not tell its status: {told}")).with_help(help)
}

/// Follows a bake to its end. On a terminal it stays in place.
async fn watch(client: Client, command: &Command, is_live: bool) -> Result<()> {
    let mut screen = Screen::default();
    let mut stop = std::pin::pin!(signalled());
    let mut last: Option<BakeStatus> = None;
    let mut failed = 0;
    while last.as_ref().is_none_or(|status| !status.phase.is_final()) {
        let followed = follow(client.clone(), &command.of, |status| {
            failed = 0;
            if is_live {
                screen.draw(&text_of(status));
            } else {
                show(status, command.json);
            }
            last = Some(status.clone());
        });
        let ended = tokio::select! {
            ended = followed => ended,
            () = &mut stop => return Ok(()),
        };
        // A coordinator may be replaced; the first answer has to come at once.
        if let Err(error) = ended {
            failed += 1;
            if last.is_none() || failed > RETRIES_MAX || error.kind == Kind::Usage {
                return Err(error);
            }
        }
        tokio::time::sleep(RETRY_EVERY).await;
    }
    Ok(())
}

async fn follow(mut client: Client, url: &str, mut seen: impl FnMut(&BakeStatus)) -> Result<()> {
    let answer = client.watch_status(v1::WatchStatusRequest {}).await;
    let mut statuses = answer.map_err(|status| failure(url, &status))?.into_inner();
    while let Some(status) = statuses.message().await.map_err(|s| failure(url, &s))? {
        seen(&read(status)?);
    }
    Ok(())
}

fn show(status: &BakeStatus, as_json: bool) {
    if as_json {
        print_json(&json_of(status));
    } else {
        print(&text_of(status));
    }
}

/// A text that is drawn over the one before.
#[derive(Default)]
struct Screen {
    lines: usize,
}

impl Screen {
    fn draw(&mut self, text: &str) {
        let columns = usize::from(console::Term::stdout().size().1).max(20);
        let lines: Vec<_> =
            text.lines().map(|line| console::truncate_str(line, columns - 1, "…")).collect();
        // Up to the first line of the text before, and nothing of it stays.
        let up = if self.lines > 0 { format!("\x1b[{}A", self.lines) } else { String::new() };
        print(&format!("{up}\r\x1b[J{}\n", lines.join("\n")));
        self.lines = lines.len();
    }
}

fn units(status: &BakeStatus) -> Done {
    let parts = [status.cells, status.segments, status.joins];
    Done {
        done: parts.iter().map(|part| part.done).sum(),
        total: parts.iter().map(|part| part.total).sum(),
    }
}

/// Time that is left at the rate so far, s.
fn seconds_left(status: &BakeStatus) -> Option<f64> {
    let all = units(status);
    let open = all.total.saturating_sub(all.done);
    (status.phase == Phase::Solving && status.units_per_second > 0.0 && open > 0)
        .then(|| open as f64 / status.units_per_second)
}

fn bar(done: Done) -> String {
    const WIDTH: u64 = 24;
    let filled = (WIDTH * done.done.min(done.total)).checked_div(done.total).unwrap_or(WIDTH);
    let share = if done.total == 0 { 100.0 } else { 100.0 * done.done as f64 / done.total as f64 };
    let (full, empty) = ("=".repeat(filled as usize), " ".repeat((WIDTH - filled) as usize));
    format!("[{full}{empty}] {share:5.1} %")
}

fn json_of(status: &BakeStatus) -> Value {
    let mut value = serde_json::to_value(status).unwrap_or_default();
    value["units"] = json!(units(status));
    value["seconds_left"] = json!(seconds_left(status));
    let stragglers: Vec<TaskId> =
        status.leases.iter().filter(|l| l.is_overdue).map(|l| l.task).collect();
    value["stragglers"] = json!(stragglers);
    value
}

fn text_of(status: &BakeStatus) -> String {
    let mut table = Table::default();
    let all = units(status);
    let of = |part: Done| format!("{} of {}", thousands(part.done), thousands(part.total));
    table.row("bake", format!("{}, epoch {}", status.bake_id, status.epoch));
    table.row("phase", phase_of(status));
    table.row("progress", format!("{}  {} units", bar(all), of(all)));
    let mut rate = format!("{:.1} units/s", status.units_per_second);
    if let Some(left) = seconds_left(status) {
        rate.push_str(&format!(", about {} left", duration(left)));
    }
    table.row("rate", rate);
    table.row("segments", of(status.segments)).row("cells", of(status.cells));
    if status.joins.total > 0 {
        table.row("joins", of(status.joins));
    }
    let t = &status.tasks;
    let mut tasks = format!(
        "{} of {} committed, {} leased, {} ready, {} waiting",
        thousands(t.committed.into()),
        thousands(t.tasks.into()),
        thousands(t.leased.into()),
        thousands(t.ready.into()),
        thousands(t.waiting.into()),
    );
    if t.quarantined > 0 {
        tasks.push_str(&format!(
            ", {} quarantined, {} blocked by them",
            thousands(t.quarantined.into()),
            thousands(status.tasks_blocked.into())
        ));
    }
    table.row("tasks", tasks);
    if status.tasks_resumed > 0 {
        table.row("resumed", count(status.tasks_resumed.into(), "task"));
    }
    if status.cells_reused + status.segments_reused > 0 {
        let (segments, cells) = (thousands(status.segments_reused), thousands(status.cells_reused));
        table.row("taken over", format!("{segments} segments, {cells} cells"));
    }
    table.row("elapsed", duration(status.elapsed_ms as f64 / 1e3));
    let mut text = table.to_string();
    add_list(&mut text, "workers", status.workers_at_hand, worker_lines(status));
    add_list(&mut text, "leases", status.leases_in_force, lease_lines(status));
    let again = status.attempts.iter();
    let again = again.map(|a| format!("task {}: {} attempts", a.task, a.attempts)).collect();
    add_list(&mut text, "attempted again", status.tasks_attempted_again, again);
    let quarantined = status.quarantined.iter();
    let quarantined =
        quarantined.map(|q| format!("task {}: {}", q.task, short(&q.reason))).collect();
    add_list(&mut text, "quarantined", t.quarantined, quarantined);
    text
}

fn phase_of(status: &BakeStatus) -> String {
    match status.phase {
        Phase::Published => format!("published, manifest {}", status.manifest),
        Phase::Failed => format!("failed: {}", short(&status.error)),
        other => other.name().into(),
    }
}

/// The busiest first.
fn worker_lines(status: &BakeStatus) -> Vec<String> {
    let mut workers: Vec<_> = status.workers.iter().collect();
    workers.sort_by_key(|w| (std::cmp::Reverse(w.tasks_committed), w.id));
    workers
        .iter()
        .map(|w| {
            let (threads, leases) =
                (count(w.threads.into(), "thread"), count(w.leases.into(), "lease"));
            let tasks = count(w.tasks_committed.into(), "task");
            format!("{} {}: {threads}, {leases}, {tasks}", w.id, w.name)
        })
        .collect()
}

/// Stragglers first, then the oldest.
fn lease_lines(status: &BakeStatus) -> Vec<String> {
    let mut leases: Vec<&LeaseStatus> = status.leases.iter().collect();
    leases.sort_by_key(|l| (!l.is_overdue, std::cmp::Reverse(l.age_ms), l.lease));
    leases
        .iter()
        .map(|l| {
            let age = duration(l.age_ms as f64 / 1e3);
            let predicted = match l.predicted_ms {
                0 => String::new(),
                ms => format!(" of {}", duration(ms as f64 / 1e3)),
            };
            let mark = if l.is_overdue { ", STRAGGLING" } else { "" };
            let who = format!("{} {}", l.worker, l.worker_name);
            format!("task {}, attempt {}, worker {who}: {age}{predicted}{mark}", l.task, l.attempt)
        })
        .collect()
}

/// A heading with the whole number, and the first lines of a list.
fn add_list(text: &mut String, what: &str, all: u32, lines: Vec<String>) {
    if all == 0 {
        return;
    }
    text.push_str(&format!("{what}  {}\n", thousands(all.into())));
    for line in lines.iter().take(SHOWN_MAX) {
        text.push_str(&format!("  {line}\n"));
    }
    let more = (all as usize).saturating_sub(lines.len().min(SHOWN_MAX));
    if more > 0 {
        text.push_str(&format!("  and {} more\n", thousands(more as u64)));
    }
}

/// One line, not too long; what workers write is not trusted with a terminal.
fn short(text: &str) -> String {
    let plain: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    if plain.chars().count() <= REASON_MAX {
        return plain;
    }
    let start: String = plain.chars().take(REASON_MAX).collect();
    format!("{start}…")
}

#[cfg(test)]
mod tests {
    use sightline_jobs::{Progress, QuarantinedTask, TaskAttempts, WorkerStatus};

    use super::*;

    fn lease(task: u32, age_ms: u64) -> LeaseStatus {
        LeaseStatus {
            task: TaskId(task),
            lease: u64::from(task),
            worker: 1,
            worker_name: "far".into(),
            attempt: 2,
            age_ms,
            predicted_ms: 4_000,
            is_overdue: age_ms > 20_000,
        }
    }

    fn sample() -> BakeStatus {
        BakeStatus {
            bake_id: "abc".into(),
            epoch: 2,
            phase: Phase::Solving,
            tasks: Progress {
                tasks: 40,
                committed: 10,
                leased: 2,
                quarantined: 1,
                ..Progress::default()
            },
            cells: Done { done: 0, total: 50 },
            segments: Done { done: 50, total: 150 },
            units_per_second: 2.0,
            workers: vec![WorkerStatus {
                id: 1,
                name: "far".into(),
                threads: 8,
                ..Default::default()
            }],
            workers_at_hand: 300,
            leases: vec![lease(3, 9_000), lease(4, 60_000)],
            leases_in_force: 2,
            attempts: vec![TaskAttempts { task: TaskId(4), attempts: 2 }],
            tasks_attempted_again: 1,
            quarantined: vec![QuarantinedTask {
                task: TaskId(9),
                reason: format!("\u{1b}[2Jworker 1: {}", "x".repeat(500)),
            }],
            ..BakeStatus::default()
        }
    }

    #[test]
    fn a_status_says_what_people_ask() {
        let text = text_of(&sample());
        for part in [
            "25.0 %",
            "50 of 200 units",
            "2.0 units/s, about 1 min 15 s left",
            "workers  300",
            "and 299 more",
            "task 4, attempt 2, worker 1 far: 1 min 00 s of 4.00 s, STRAGGLING",
            "task 4: 2 attempts",
            "1 quarantined",
            "task 9:",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
        assert!(!text.contains("of 4.00 s\n  task 4"), "stragglers come first: {text}");
        assert!(!text.contains('\u{1b}'), "reasons do not reach the terminal as they are");
    }

    #[test]
    fn json_names_stragglers_and_the_time_left() {
        let value = json_of(&sample());
        assert_eq!(value["stragglers"], json!([4]));
        assert_eq!(value["seconds_left"], json!(75.0));
        assert_eq!(value["phase"], "solving");
        assert_eq!(value["leases"][0]["age_ms"], 9_000);
    }
}
