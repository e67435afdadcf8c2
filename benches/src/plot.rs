//! Plots of curves as SVG.

use std::path::Path;

use plotters::prelude::*;

use crate::curve::{Curve, Point};

const SIZE: (u32, u32) = (860, 560);

/// Colours that also differ in grey and for colour-blind eyes (Okabe and Ito). The first is ours.
const COLORS: [RGBColor; 7] = [
    RGBColor(0, 0, 0),
    RGBColor(213, 94, 0),
    RGBColor(0, 114, 178),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
];

/// What the second axis shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Axis {
    /// Mean pixel error, per cent.
    Error,
    /// Primitives found.
    Found,
}

/// Powers of ten around `values`.
fn decades(values: impl Iterator<Item = f64>) -> Option<std::ops::Range<f64>> {
    let (low, high) = values.fold((f64::INFINITY, 0.0f64), |(l, h), v| (l.min(v), h.max(v)));
    (low.is_finite() && low > 0.0)
        .then(|| 10f64.powf(low.log10().floor())..10f64.powf((high * 1.001).log10().ceil()))
}

/// Draws time against `axis`, logarithmic both. Errors below `floor` (nothing was seen to be wrong)
/// are drawn at it.
///
/// # Errors
/// When the file cannot be written.
pub fn draw(
    path: &Path,
    title: &str,
    curves: &[Curve],
    axis: Axis,
    floor: f64,
) -> Result<(), String> {
    let value = |p: &Point| match axis {
        Axis::Error => 100.0 * p.error.mean.max(floor),
        Axis::Found => p.found.max(1) as f64,
    };
    let points = || curves.iter().flat_map(|c| &c.points);
    let Some((times, values)) =
        decades(points().map(|p| p.seconds)).zip(decades(points().map(value)))
    else {
        return Ok(());
    };
    let name = match axis {
        Axis::Error => "mean pixel error, %",
        Axis::Found => "triangles found",
    };
    let draw = || -> Result<(), Box<dyn std::error::Error>> {
        let root = SVGBackend::new(path, SIZE).into_drawing_area();
        root.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&root)
            .caption(title, ("sans-serif", 18))
            .margin(12)
            .x_label_area_size(42)
            .y_label_area_size(70)
            .build_cartesian_2d(times.log_scale(), values.log_scale())?;
        chart
            .configure_mesh()
            .light_line_style(RGBColor(240, 240, 240))
            .x_desc("run time, s")
            .y_desc(name)
            .x_label_formatter(&|v| number(*v))
            .y_label_formatter(&|v| number(*v))
            .draw()?;
        for (k, curve) in curves.iter().enumerate() {
            let color = COLORS[k % COLORS.len()];
            let style = color.stroke_width(if k == 0 { 3 } else { 2 });
            let line: Vec<(f64, f64)> =
                curve.points.iter().map(|p| (p.seconds, value(p))).collect();
            chart
                .draw_series(LineSeries::new(line.iter().copied(), style))?
                .label(&curve.method)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], style));
            chart.draw_series(line.iter().map(|&at| Circle::new(at, 3, color.filled())))?;
        }
        chart
            .configure_series_labels()
            .background_style(WHITE.mix(0.85))
            .border_style(RGBColor(200, 200, 200))
            .position(match axis {
                Axis::Error => SeriesLabelPosition::UpperRight,
                Axis::Found => SeriesLabelPosition::LowerRight,
            })
            .draw()?;
        root.present()?;
        Ok(())
    };
    draw().map_err(|e| format!("{}: {e}", path.display()))
}

/// Draws lines through points, both axes linear and from 0.
///
/// # Errors
/// When the file cannot be written.
pub fn draw_lines(
    path: &Path,
    title: &str,
    (x, y): (&str, &str),
    lines: &[(&str, Vec<(f64, f64)>)],
) -> Result<(), String> {
    let points = || lines.iter().flat_map(|(_, points)| points);
    let most = |of: fn(&(f64, f64)) -> f64| 1.05 * points().map(of).fold(0.0, f64::max);
    let (width, height) = (most(|p| p.0), most(|p| p.1));
    if width <= 0.0 || height <= 0.0 {
        return Ok(());
    }
    let draw = || -> Result<(), Box<dyn std::error::Error>> {
        let root = SVGBackend::new(path, SIZE).into_drawing_area();
        root.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&root)
            .caption(title, ("sans-serif", 18))
            .margin(12)
            .x_label_area_size(42)
            .y_label_area_size(70)
            .build_cartesian_2d(0.0..width, 0.0..height)?;
        chart
            .configure_mesh()
            .light_line_style(RGBColor(240, 240, 240))
            .x_desc(x)
            .y_desc(y)
            .draw()?;
        for (k, (name, points)) in lines.iter().enumerate() {
            let color = COLORS[k % COLORS.len()];
            let style = color.stroke_width(if k == 0 { 3 } else { 2 });
            chart
                .draw_series(LineSeries::new(points.iter().copied(), style))?
                .label(*name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], style));
            chart.draw_series(points.iter().map(|&at| Circle::new(at, 3, color.filled())))?;
        }
        chart
            .configure_series_labels()
            .background_style(WHITE.mix(0.85))
            .border_style(RGBColor(200, 200, 200))
            .position(SeriesLabelPosition::UpperLeft)
            .draw()?;
        root.present()?;
        Ok(())
    };
    draw().map_err(|e| format!("{}: {e}", path.display()))
}

fn number(v: f64) -> String {
    if (1e-4..1e6).contains(&v) { format!("{v}") } else { format!("{v:e}") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::truth::Error;

    #[test]
    fn a_plot_names_every_method_and_survives_errors_of_zero() {
        let point = |seconds, mean| Point {
            label: String::new(),
            seconds,
            found: 10,
            error: Error { mean, worst: mean },
        };
        let curve = |name: &str| Curve {
            method: name.into(),
            points: vec![point(0.1, 0.5), point(3.0, 0.0)],
            ended: None,
        };
        let folder = std::env::temp_dir().join(format!("sightline-plot-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("a.svg");
        draw(&path, "title", &[curve("one"), curve("another")], Axis::Error, 1e-6).unwrap();
        let svg = std::fs::read_to_string(&path).unwrap();
        std::fs::remove_dir_all(&folder).unwrap();
        assert!(svg.contains("one") && svg.contains("another") && svg.contains("title"));
        assert_eq!(svg.matches("<circle").count(), 4, "every point is there");
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
    }
}
