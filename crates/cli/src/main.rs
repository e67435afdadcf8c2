//! The `sightline` command.
//!
//! Results go to stdout: text for people, or with `--json` one JSON object. Progress, notes, logs
//! and errors go to stderr. Exit codes are in [`failure`].

mod arguments;
mod commands;
mod failure;
mod memory;
mod progress;
mod report;

use std::process::ExitCode;

use clap::Parser;
use sightline_telemetry::trace::TraceError;
use sightline_telemetry::{LogOptions, Telemetry};

use arguments::Arguments;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let telemetry = start_telemetry(&arguments);
    if arguments.quiet {
        progress::be_quiet();
    }
    progress::use_style(arguments.progress);
    let json = arguments.command.wants_json();
    let ended = match &telemetry {
        Ok(_) => commands::run(arguments.command),
        Err(error) => Err(failure::Failure::new(failure::Kind::Usage, error.to_string())),
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            // A negative answer is an answer: the command has printed it.
            if json && failure.kind != failure::Kind::Negative {
                report::print_json(&failure.to_json());
            }
            let code = failure.kind.exit_code();
            progress::failed(&failure.to_line());
            show(failure);
            ExitCode::from(code)
        }
    }
}

/// Prints a failure for people, on stderr. Lines are not wrapped: they hold commands to copy.
fn show(failure: failure::Failure) {
    // Fails when a hook is set already, which nobody does.
    let _ = miette::set_hook(Box::new(|_| {
        Box::new(miette::MietteHandlerOpts::new().wrap_lines(false).build())
    }));
    let text = format!("{:?}", miette::Report::new(failure));
    progress::always(text.trim_end());
}

fn start_telemetry(arguments: &Arguments) -> Result<Telemetry, TraceError> {
    let default = match (arguments.quiet, arguments.verbose) {
        (true, _) => "error",
        (false, 0) => "warn",
        (false, 1) => "warn,sightline=info",
        (false, _) => "info,sightline=debug",
    };
    let (format, service) = (arguments.command.log_format(), arguments.command.service());
    Telemetry::start(LogOptions { format, filter: default, service }, || progress::LogWriter)
}
