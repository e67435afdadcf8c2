//! The tables of a comparison, as Markdown.

use std::fmt::Write;

use crate::curve::Curve;
use crate::single_segment::SingleSegment;

/// What tracers do on a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct TracerSpeed {
    /// Name of the tracer.
    pub tracer: &'static str,
    /// Rays a second of all threads: frames from one viewpoint, in the order of a curve.
    pub frames: f64,
    /// Rays a second of all threads: each ray from its own viewpoint, directions in the order of
    /// a curve.
    pub scattered: f64,
    /// Rays a second of all threads: random directions in random order.
    pub random: f64,
    /// Seconds to build.
    pub build: f64,
}

/// Everything measured on a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneReport {
    /// Name of the scene.
    pub name: String,
    /// What it is: triangles, rectangle, segments.
    pub about: String,
    /// Speed of tracers.
    pub tracers: Vec<TracerSpeed>,
    /// Curves, ours first.
    pub curves: Vec<Curve>,
    /// Comparison on one segment.
    pub single: Vec<SingleSegment>,
    /// Error of one ray of one viewpoint, as it counts in the mean.
    pub floor: f64,
}

/// Rivals' points that are below our curve: method, label, time, its error and ours at that time
/// (at our first time, for points before it).
#[must_use]
pub fn points_below(curves: &[Curve], floor: f64) -> Vec<(String, String, f64, f64, f64)> {
    let Some((ours, rivals)) = curves.split_first() else { return Vec::new() };
    let mut below = Vec::new();
    for rival in rivals {
        for p in &rival.points {
            // Behind our last point, our curve goes on at its level; who is there before our first
            // point with less error than it is below as well.
            let front = ours.front();
            let (Some(first), Some(last)) = (front.first(), front.last()) else { continue };
            let our_error = if p.seconds < first.seconds {
                Some(first.error.mean)
            } else if p.seconds > last.seconds {
                Some(last.error.mean)
            } else {
                ours.front_at(p.seconds, floor)
            };
            if let Some(our_error) = our_error
                && p.error.mean < our_error
            {
                let label = p.label.clone();
                below.push((rival.method.clone(), label, p.seconds, p.error.mean, our_error));
            }
        }
    }
    below
}

/// A number with three significant digits.
#[must_use]
pub fn digits(v: f64) -> String {
    if v == 0.0 || !v.is_finite() {
        return format!("{v}");
    }
    let places = (2 - v.abs().log10().floor() as i32).clamp(0, 8) as usize;
    format!("{v:.places$}")
}

fn per_cent(v: f64) -> String {
    format!("{} %", digits(100.0 * v))
}

/// What is claimed, and what was measured, over all scenes.
#[must_use]
pub fn claims(scenes: &[SceneReport]) -> String {
    let mut out = String::new();
    let _ = writeln!(out, "| scene | claim | measured | holds |");
    let _ = writeln!(out, "| --- | --- | --- | --- |");
    let mut add = |scene: &str, claim: &str, measured: String, holds: Option<bool>| {
        let holds = holds.map_or("not settled", |h| if h { "yes" } else { "no" });
        let _ = writeln!(out, "| {scene} | {claim} | {measured} | {holds} |");
    };
    for SceneReport { name, curves, single, floor, .. } in scenes {
        for s in single {
            let rows = s.rows;
            let ratio = s.from_segment / s.from_point;
            let claim = format!("{rows} rows cost at most one from-point run over as many rays");
            add(name, &claim, format!("{} times", digits(ratio)), Some(ratio <= 1.0));
            for (kind, race) in [("the same", &s.same), ("fresh", &s.fresh)] {
                let claim = format!("{rows} rows, equal time, {kind} directions: at most 80 %");
                let share = race.share_at_equal_time;
                add(name, &claim, per_cent(share), Some(share <= 0.8));
                let claim = format!("{rows} rows, equal quality, {kind} directions: 500 times");
                match race.time_to_share[3] {
                    Some(time) => {
                        add(name, &claim, format!("{} times", digits(time)), Some(time >= 500.0))
                    }
                    None => {
                        let measured = format!("more than {} times", digits(race.stopped));
                        add(name, &claim, measured, (race.stopped >= 500.0).then_some(true));
                    }
                }
            }
        }
        let below = points_below(curves, *floor);
        let mut methods: Vec<&str> = below.iter().map(|b| b.0.as_str()).collect();
        methods.dedup();
        let measured = match methods.as_slice() {
            [] => "none is".to_owned(),
            methods => format!("{} points of {}", below.len(), methods.join("; ")),
        };
        add(name, "no rival is below our curve", measured, Some(below.is_empty()));
    }
    out + "\n"
}

/// The section of a scene.
#[must_use]
pub fn section(scene: &SceneReport) -> String {
    let mut out = String::new();
    let SceneReport { name, about, tracers, curves, single, floor } = scene;
    let _ = writeln!(out, "## {name}\n\n{about}\n");
    let _ = writeln!(out, "Ray tracers, million rays a second of all threads:\n");
    let _ = writeln!(out, "| tracer | frames | own viewpoint a ray | random order | build |");
    let _ = writeln!(out, "| --- | --- | --- | --- | --- |");
    for t in tracers {
        let [frames, scattered, random] =
            [t.frames, t.scattered, t.random].map(|v| digits(v / 1e6));
        let build = digits(t.build);
        let _ = writeln!(out, "| {} | {frames} | {scattered} | {random} | {build} s |", t.tracer);
    }
    let _ = writeln!(out, "\n![error against time]({name}-error.svg)\n");
    let _ = writeln!(out, "![triangles against time]({name}-found.svg)\n");
    let _ = writeln!(out, "| method | done | time | triangles | mean error | worst error |");
    let _ = writeln!(out, "| --- | --- | --- | --- | --- | --- |");
    for curve in curves {
        for p in &curve.points {
            let (mean, worst) = (per_cent(p.error.mean), per_cent(p.error.worst));
            let (method, label, time) = (&curve.method, &p.label, digits(p.seconds));
            let _ =
                writeln!(out, "| {method} | {label} | {time} s | {} | {mean} | {worst} |", p.found);
        }
        if let Some(why) = &curve.ended {
            let _ = writeln!(out, "| {} | {why} | | | | |", curve.method);
        }
    }
    let below = points_below(curves, *floor);
    if below.is_empty() {
        let _ = writeln!(out, "\nNo rival has a point below our curve.");
    } else {
        let _ = writeln!(out, "\nRivals have {} points below our curve:\n", below.len());
        let _ = writeln!(out, "| method | done | time | its error | ours at that time |");
        let _ = writeln!(out, "| --- | --- | --- | --- | --- |");
        for (method, label, seconds, error, ours) in below {
            let (time, error, ours) = (digits(seconds), per_cent(error), per_cent(ours));
            let _ = writeln!(out, "| {method} | {label} | {time} s | {error} | {ours} |");
        }
    }
    if !single.is_empty() {
        let _ = writeln!(
            out,
            "\nOne segment against as many rays from one of its points, and against from-point sampling:\n"
        );
        let _ = write!(out, "{}", crate::single_segment::table(single));
    }
    let _ = writeln!(out);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::curve::Point;
    use crate::truth::Error;

    fn curve(points: &[(f64, f64)]) -> Curve {
        let point = |&(seconds, mean): &(f64, f64)| Point {
            label: "x".into(),
            seconds,
            found: 0,
            error: Error { mean, worst: mean },
        };
        Curve { points: points.iter().map(point).collect(), ..Curve::default() }
    }

    #[test]
    fn points_below_are_found_before_between_and_behind_ours() {
        let ours = curve(&[(1.0, 0.1), (100.0, 0.001)]);
        let rival = curve(&[(0.4, 0.2), (0.5, 0.01), (10.0, 0.02), (10.0, 0.005), (200.0, 0.0005)]);
        let below = points_below(&[ours, rival], 1e-9);
        let times: Vec<f64> = below.iter().map(|b| b.2).collect();
        assert_eq!(times, [0.5, 10.0, 200.0]);
        assert!((below[1].4 - 0.01).abs() < 1e-9);
    }

    #[test]
    fn numbers_have_three_digits() {
        let all = [0.0, 1234.5, 12.345, 0.012345, 1e-7].map(digits);
        assert_eq!(all, ["0", "1234", "12.3", "0.0123", "0.00000010"]);
    }
}
