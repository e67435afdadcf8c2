//! Time that a method took, with pauses for what is not its work.

use std::time::{Duration, Instant};

use cpu_time::ProcessTime;

/// Which time is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Clock {
    /// Time on the wall: right on a machine that does nothing else.
    Wall,
    /// Processor time of all threads over the number of threads: what the wall would show, were
    /// all threads busy throughout. For machines that others use too.
    Processor,
}

/// Adds up the time of the pieces that are run through it.
#[derive(Clone, Debug)]
pub struct Stopwatch {
    clock: Clock,
    wall: Duration,
    processor: Duration,
}

impl Stopwatch {
    /// A stopwatch that shows nothing yet.
    #[must_use]
    pub fn new(clock: Clock) -> Self {
        Self { clock, wall: Duration::ZERO, processor: Duration::ZERO }
    }

    /// Runs `work` and adds its time.
    pub fn time<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let (wall, processor) = (Instant::now(), ProcessTime::now());
        let out = work();
        self.processor += processor.elapsed();
        self.wall += wall.elapsed();
        out
    }

    /// Seconds so far, on the clock that is compared.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        seconds(self.clock, self.wall, self.processor)
    }
}

/// A moment on a clock by which work must have ended.
#[derive(Clone, Copy, Debug)]
pub struct Deadline {
    clock: Clock,
    seconds: f64,
    began: (Instant, ProcessTime),
}

impl Deadline {
    /// `seconds` from now.
    #[must_use]
    pub fn after(clock: Clock, seconds: f64) -> Self {
        Self { clock, seconds, began: (Instant::now(), ProcessTime::now()) }
    }

    /// True when it has passed.
    #[must_use]
    pub fn is_past(&self) -> bool {
        let (wall, processor) = (self.began.0.elapsed(), self.began.1.elapsed());
        seconds(self.clock, wall, processor) > self.seconds
    }
}

fn seconds(clock: Clock, wall: Duration, processor: Duration) -> f64 {
    match clock {
        Clock::Wall => wall.as_secs_f64(),
        Clock::Processor => processor.as_secs_f64() / rayon::current_num_threads().max(1) as f64,
    }
}

/// Seconds of one call, the fastest of as many as fit in `budget` seconds (at least one).
pub fn fastest(clock: Clock, budget: f64, mut work: impl FnMut()) -> f64 {
    let (mut best, mut spent) = (f64::INFINITY, 0.0);
    while spent < budget {
        let mut watch = Stopwatch::new(clock);
        watch.time(&mut work);
        best = best.min(watch.seconds());
        spent += watch.seconds().max(1e-3);
    }
    best
}
