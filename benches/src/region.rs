//! The rectangle whose visible set every method looks for.

use clap::Args;
use glam::DVec3;
use sightline_geometry::{SegmentId, ViewSegment};

/// An upright rectangle without thickness: viewers' eyes at one height.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Region {
    /// Lower x and z, metres.
    pub low: [f64; 2],
    /// Upper x and z, metres.
    pub high: [f64; 2],
    /// Height of the eyes, metres.
    pub y: f64,
}

/// A scene and the rectangle in it, as the benches take them.
#[derive(Args, Clone, Debug)]
pub struct Place {
    /// The scene, glTF.
    pub scene: std::path::PathBuf,
    /// x0,z0,x1,z1 of the rectangle, metres.
    #[arg(long, required = true, value_delimiter = ',', allow_hyphen_values = true)]
    pub region: Vec<f64>,
    /// Height of the perimeter, metres.
    #[arg(long, allow_hyphen_values = true)]
    pub y: f64,
}

impl Place {
    /// The rectangle.
    ///
    /// # Errors
    /// When it has not four numbers, or a side has no length.
    pub fn rectangle(&self) -> Result<Region, String> {
        let corners: [f64; 4] = self.region[..]
            .try_into()
            .map_err(|_| format!("--region takes x0,z0,x1,z1, not {:?}", self.region))?;
        Region::new(corners, self.y)
    }
}

impl Region {
    /// The region of corners `x0, z0, x1, z1` at height `y`.
    ///
    /// # Errors
    /// When a side has no length.
    pub fn new([x0, z0, x1, z1]: [f64; 4], y: f64) -> Result<Self, String> {
        if x0 < x1 && z0 < z1 && y.is_finite() && x1 - x0 < 1e6 && z1 - z0 < 1e6 {
            Ok(Self { low: [x0, z0], high: [x1, z1], y })
        } else {
            Err(format!("a rectangle has x0 < x1 and z0 < z1, not {x0},{z0},{x1},{z1}"))
        }
    }

    /// The point at shares `u` of x and `v` of z.
    #[must_use]
    pub fn at(&self, u: f64, v: f64) -> DVec3 {
        let mix = |k: usize, s: f64| self.low[k] + s * (self.high[k] - self.low[k]);
        DVec3::new(mix(0, u), self.y, mix(1, v))
    }

    /// The middle.
    #[must_use]
    pub fn center(&self) -> DVec3 {
        self.at(0.5, 0.5)
    }

    /// The perimeter, cut into pieces of at most `length` metres.
    #[must_use]
    pub fn perimeter(&self, length: f64) -> Vec<ViewSegment> {
        let corners = [self.at(0.0, 0.0), self.at(1.0, 0.0), self.at(1.0, 1.0), self.at(0.0, 1.0)];
        let mut out = Vec::new();
        for k in 0..4 {
            let (a, b) = (corners[k], corners[(k + 1) % 4]);
            let pieces = ((b - a).length() / length).ceil().max(1.0) as u32;
            for i in 0..pieces {
                let at = |i: u32| a.lerp(b, f64::from(i) / f64::from(pieces));
                out.push(ViewSegment { id: SegmentId(out.len() as u32), v0: at(i), v1: at(i + 1) });
            }
        }
        out
    }

    /// `count` points spread evenly over the inside.
    ///
    /// Source: the additive recurrence R2 (Roberts, "The Unreasonable Effectiveness of
    /// Quasirandom Sequences").
    #[must_use]
    pub fn viewpoints(&self, count: u32) -> Vec<DVec3> {
        const PLASTIC: f64 = 1.324_717_957_244_746;
        let share = |k: u32, step: f64| (0.5 + f64::from(k) * step).fract();
        (0..count)
            .map(|k| self.at(share(k, 1.0 / PLASTIC), share(k, 1.0 / (PLASTIC * PLASTIC))))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_perimeter_is_closed_and_its_pieces_are_short() {
        let region = Region::new([-5.0, 2.0, 5.0, 6.5], 1.7).unwrap();
        let segments = region.perimeter(2.0);
        assert_eq!(segments.len(), 2 * (5 + 3));
        for (k, s) in segments.iter().enumerate() {
            assert_eq!(s.v1, segments[(k + 1) % segments.len()].v0);
            assert!((s.v1 - s.v0).length() <= 2.0);
        }
        assert!(Region::new([1.0, 0.0, 1.0, 1.0], 0.0).is_err());
    }

    #[test]
    fn viewpoints_lie_inside() {
        let region = Region::new([-5.0, 2.0, 5.0, 6.5], 1.7).unwrap();
        for p in region.viewpoints(100) {
            assert!(p.x > -5.0 && p.x < 5.0 && p.z > 2.0 && p.z < 6.5 && p.y == 1.7);
        }
    }
}
