//! When a process is asked to stop, and how one that serves a bake runs and ends.

use std::io::Write;
use std::process::ExitCode;

use crate::{LogOptions, Telemetry};

/// Exit code of a process that was asked twice to stop, as shells have it for Ctrl-C.
pub const INTERRUPTED: i32 = 130;

/// Until someone asks the process to stop: SIGTERM, as container platforms and service managers
/// send it, or Ctrl-C. `asked_again` is called at the next time: to end the process at once, with
/// [`INTERRUPTED`]. Signals are heard from the call on, whenever the future is waited for.
///
/// # Panics
/// Outside of a runtime.
pub fn signalled(asked_again: impl FnOnce() + Send + 'static) -> impl Future<Output = ()> {
    let mut signals = Signals::listen();
    async move {
        if !signals.next().await {
            // No handler could be set: the default action ends the process.
            std::future::pending::<()>().await;
        }
        tokio::spawn(async move {
            if signals.next().await {
                asked_again();
            }
        });
    }
}

/// The signals that ask for an end.
struct Signals {
    #[cfg(unix)]
    terminate: Option<tokio::signal::unix::Signal>,
}

impl Signals {
    fn listen() -> Self {
        Self {
            #[cfg(unix)]
            terminate: tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())
                .ok(),
        }
    }

    /// True at the next signal, false when there is no telling.
    async fn next(&mut self) -> bool {
        #[cfg(unix)]
        if let Some(terminate) = &mut self.terminate {
            return tokio::select! {
                _ = terminate.recv() => true,
                interrupted = tokio::signal::ctrl_c() => interrupted.is_ok(),
            };
        }
        tokio::signal::ctrl_c().await.is_ok()
    }
}

/// Runs a process to its end, with its logs on standard error. A failure is logged and is its exit code.
pub fn run<E: std::fmt::Display>(
    logs: LogOptions,
    process: impl Future<Output = Result<(), E>>,
) -> ExitCode {
    let telemetry = match Telemetry::to_stderr(logs) {
        Ok(telemetry) => telemetry,
        Err(error) => {
            // There are no logs to say it in. Where there is no standard error, there is the exit code.
            let _ = writeln!(std::io::stderr(), "{error}");
            return ExitCode::FAILURE;
        }
    };
    let ended = match tokio::runtime::Runtime::new() {
        Ok(runtime) => {
            let ended = runtime.block_on(process).map_err(|error| error.to_string());
            // What still runs on its threads has nobody who waits for it.
            runtime.shutdown_background();
            ended
        }
        Err(error) => Err(error.to_string()),
    };
    if let Err(error) = &ended {
        tracing::error!("{error}");
    }
    // Sends the traces that are left.
    drop(telemetry);
    if ended.is_ok() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
