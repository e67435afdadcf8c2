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
use tracing_subscriber::EnvFilter;

use arguments::Arguments;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    start_logging(&arguments);
    if arguments.quiet {
        progress::be_quiet();
    }
    progress::use_style(arguments.progress);
    let json = arguments.command.wants_json();
    match commands::run(arguments.command) {
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

fn start_logging(arguments: &Arguments) {
    let default = match (arguments.quiet, arguments.verbose) {
        (true, _) => "error",
        (false, 0) => "warn",
        (false, 1) => "warn,sightline=info",
        (false, _) => "info,sightline=debug",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(default));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(|| progress::LogWriter).init();
}
