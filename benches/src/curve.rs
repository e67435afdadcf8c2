//! A method's curve: what it has found, and how wrong that is, against time.

use sightline_geometry::PrimitiveSet;

use crate::clock::{Clock, Stopwatch};
use crate::truth::{Error, Truth};

/// A moment of a method.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// What was done until then, such as "rows 64" or "12.6 M rays".
    pub label: String,
    /// Time it took, seconds.
    pub seconds: f64,
    /// Primitives found.
    pub found: u64,
    /// Error of the set found.
    pub error: Error,
}

/// A method on a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Curve {
    /// Name of the method.
    pub method: String,
    /// In order of time.
    pub points: Vec<Point>,
    /// Why it ended early, if it did.
    pub ended: Option<String>,
}

/// A method that finds more and more.
pub trait Progressive {
    /// Works on for some ten milliseconds; false when there is nothing left to do.
    fn step(&mut self) -> bool;
    /// Everything found so far.
    fn found(&self) -> PrimitiveSet;
    /// What was done so far.
    fn label(&self) -> String;
}

/// What curves are measured against.
#[derive(Clone, Copy)]
pub struct Judge<'a> {
    /// What is really seen.
    pub truth: &'a Truth,
    /// Primitives of the scene.
    pub primitives: u32,
    /// The clock that is compared.
    pub clock: Clock,
    /// Time a method may take, seconds.
    pub limit: f64,
}

impl Judge<'_> {
    /// The point of a finished set.
    #[must_use]
    pub fn point(&self, label: String, seconds: f64, set: &PrimitiveSet) -> Point {
        let error = self.truth.error(set, self.primitives);
        Point { label, seconds, found: set.len(), error }
    }

    /// Runs a method until it ends or its time is up, with a point each time the time has doubled.
    pub fn follow(&self, method: &str, progressive: &mut impl Progressive) -> Curve {
        let mut watch = Stopwatch::new(self.clock);
        let mut points = Vec::new();
        let mut next = self.limit / f64::from(1 << 8);
        let mut ended = None;
        loop {
            let more = watch.time(|| progressive.step());
            let seconds = watch.seconds();
            let is_over = seconds >= self.limit;
            if !more || is_over || seconds >= next {
                points.push(self.point(progressive.label(), seconds, &progressive.found()));
                while next <= seconds {
                    next *= 2.0;
                }
            }
            if !more {
                break;
            }
            if is_over {
                ended = Some(format!("stopped by the time limit of {} s", self.limit));
                break;
            }
        }
        Curve { method: method.into(), points, ended }
    }
}

impl Curve {
    /// The error that the method has reached after `seconds`: that of the last point until then.
    #[must_use]
    pub fn error_at(&self, seconds: f64) -> Option<f64> {
        self.points.iter().filter(|p| p.seconds <= seconds).map(|p| p.error.mean).reduce(f64::min)
    }

    /// The time at which the method has found `count` primitives, if it got there.
    #[must_use]
    pub fn time_to_find(&self, count: u64) -> Option<f64> {
        self.points.iter().filter(|p| p.found >= count).map(|p| p.seconds).reduce(f64::min)
    }

    /// The points that no other of the curve beats in both time and error, in order of time.
    #[must_use]
    pub fn front(&self) -> Vec<&Point> {
        let mut points: Vec<&Point> = self.points.iter().collect();
        points.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
        let mut best = f64::INFINITY;
        points.retain(|p| {
            let better = p.error.mean < best;
            best = best.min(p.error.mean);
            better
        });
        points
    }

    /// The error at `seconds` on the front, straight between its points on logarithmic axes;
    /// `None` before the first point and behind the last.
    #[must_use]
    pub fn front_at(&self, seconds: f64, floor: f64) -> Option<f64> {
        let front = self.front();
        let pair = front.windows(2).find(|p| p[0].seconds <= seconds && seconds <= p[1].seconds)?;
        let [a, b] = [pair[0], pair[1]];
        let share = (seconds / a.seconds).ln() / (b.seconds / a.seconds).ln();
        let (ea, eb) = (a.error.mean.max(floor).ln(), b.error.mean.max(floor).ln());
        Some((ea + share * (eb - ea)).exp())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(points: &[(f64, f64)]) -> Curve {
        let point = |&(seconds, mean): &(f64, f64)| Point {
            label: String::new(),
            seconds,
            found: 0,
            error: Error { mean, worst: mean },
        };
        Curve { points: points.iter().map(point).collect(), ..Curve::default() }
    }

    #[test]
    fn fronts_leave_out_what_is_beaten() {
        let c = curve(&[(1.0, 0.1), (2.0, 0.2), (4.0, 0.001)]);
        let times: Vec<f64> = c.front().iter().map(|p| p.seconds).collect();
        assert_eq!(times, [1.0, 4.0]);
        assert!((c.front_at(2.0, 1e-9).unwrap() - 0.01).abs() < 1e-12);
        assert_eq!(c.front_at(0.5, 1e-9), None);
        assert_eq!(c.error_at(3.0), Some(0.1));
    }
}
