//! View regions: where viewers can be, cut into cells.
//!
//! A region is rectangles and simple polygons on the ground plane (XZ) with an eye-height range.
//! Its bounding box is cut into squares of the cell size, from its lower corner; a square that
//! shares an area with the region becomes a cell. Each corner of a cell stands at its eye height:
//! absolute, or above the ground under that corner (a ray down on the objects that a name pattern
//! calls ground), so cells and their segments follow slopes. Neighbours share corners to the bit.
//!
//! Skipped, and counted by reason:
//! - squares outside the region;
//! - cells with a corner that has no ground below it;
//! - cells inside a solid: nothing reaches into the cell, so all of it is on one side of every
//!   surface, and every one of a fixed bundle of rays from its centre ends on the back of a
//!   single-sided surface. Rays that end on the ground tell nothing (terrain goes on below
//!   buildings), where names tell the ground apart from other objects; but more than half of
//!   the rays have to end on backs.
//!
//! Cells are numbered along a Hilbert curve over the squares.

use std::collections::{BTreeMap, HashMap};

use glam::DVec3;
use globset::{Glob, GlobSet, GlobSetBuilder};
use rayon::prelude::*;
use sightline_geometry::{
    CellId, Place, PrimitiveId, Ray, ViewCell, overlap::primitives_in_cell, raycast::RayCaster,
};

use crate::Scene;

/// Most squares that a region may be cut into: ids are 32 bits, and a plan has to fit in memory.
const SQUARES_MAX: f64 = (1u64 << 26) as f64;

/// What heights mean.
#[derive(Clone, Debug, PartialEq)]
pub enum Heights {
    /// Eye heights are world y.
    Absolute,
    /// Eye heights are above the ground under each corner.
    AboveGround {
        /// World y at which the rays down start; above everything when absent.
        from: Option<f64>,
        /// Glob patterns on object names; what is called ground.
        ground: Vec<String>,
    },
}

/// A view region and how to cut it.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionSpec {
    /// Rectangles `[x0, z0, x1, z1]`, metres.
    pub rectangles: Vec<[f64; 4]>,
    /// Simple polygons, corners `[x, z]`, metres.
    pub polygons: Vec<Vec<[f64; 2]>>,
    /// Edge of a square, metres.
    pub cell_size: f64,
    /// Lower and upper eye height, metres.
    pub eye_height: [f64; 2],
    /// What heights mean.
    pub heights: Heights,
}

/// A region cut into cells.
#[derive(Clone, Debug, PartialEq)]
pub struct TiledRegion {
    /// The cells in order of their id, each with its square's column and row.
    pub cells: Vec<(ViewCell, [i32; 2])>,
    /// Number of squares that became no cell, by reason.
    pub skipped: BTreeMap<String, u64>,
}

/// Why a region cannot be cut.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RegionError {
    /// No rectangle and no polygon.
    #[error("the view region is empty: give at least one rectangle or polygon")]
    Empty,
    /// A shape has no area or a coordinate that is not finite.
    #[error("{shape} has no area or a coordinate that is not finite")]
    BadShape {
        /// Which one, such as "rectangle 2".
        shape: String,
    },
    /// The cell size or the eye heights make no sense.
    #[error("{key} = {value}: {rule}")]
    BadNumber {
        /// Configuration key.
        key: &'static str,
        /// Its value.
        value: String,
        /// What it has to be.
        rule: &'static str,
    },
    /// Too many squares.
    #[error(
        "the region needs {squares:.0} cells of {cell_size} m: use larger cells or a smaller region"
    )]
    TooManyCells {
        /// Squares in the region's bounding box.
        squares: f64,
        /// Edge of a square, metres.
        cell_size: f64,
    },
    /// A glob pattern cannot be parsed.
    #[error("ground pattern `{pattern}`: {message}")]
    BadPattern {
        /// The pattern.
        pattern: String,
        /// What is wrong with it.
        message: String,
    },
    /// No object is called ground.
    #[error(
        "no object's name matches the ground patterns {patterns:?}; `sightline info` lists names"
    )]
    NoGround {
        /// The patterns.
        patterns: Vec<String>,
    },
}

type Polygon = Vec<[f64; 2]>;

/// Twice the signed area of a polygon.
fn area(polygon: &[[f64; 2]]) -> f64 {
    (0..polygon.len())
        .map(|k| {
            let (a, b) = (polygon[k], polygon[(k + 1) % polygon.len()]);
            a[0] * b[1] - b[0] * a[1]
        })
        .sum()
}

/// The part of a polygon on one side of `axis = at`.
fn clip(polygon: &[[f64; 2]], axis: usize, at: f64, keep_above: bool) -> Polygon {
    let side = |p: [f64; 2]| if keep_above { p[axis] - at } else { at - p[axis] };
    let mut out = Vec::with_capacity(polygon.len() + 1);
    for (k, &p) in polygon.iter().enumerate() {
        let q = polygon[(k + 1) % polygon.len()];
        let (a, b) = (side(p), side(q));
        if a >= 0.0 {
            out.push(p);
        }
        if (a > 0.0 && b < 0.0) || (a < 0.0 && b > 0.0) {
            let share = a / (a - b);
            out.push([p[0] + share * (q[0] - p[0]), p[1] + share * (q[1] - p[1])]);
        }
    }
    out
}

/// True when a polygon and a box share an area.
fn meets(polygon: &[[f64; 2]], low: [f64; 2], high: [f64; 2]) -> bool {
    let mut part = polygon.to_vec();
    for axis in 0..2 {
        part = clip(&part, axis, low[axis], true);
        part = clip(&part, axis, high[axis], false);
    }
    // Less than a 10^-9 part of the square is rounding of its own corners.
    area(&part).abs() > 2e-9 * (high[0] - low[0]) * (high[1] - low[1])
}

fn shapes(spec: &RegionSpec) -> Result<Vec<Polygon>, RegionError> {
    let bad_number =
        |key, value: f64, rule| Err(RegionError::BadNumber { key, value: value.to_string(), rule });
    if !(spec.cell_size > 0.0 && spec.cell_size.is_finite()) {
        return bad_number("region.cell_size", spec.cell_size, "must be greater than 0 metres");
    }
    let [low, high] = spec.eye_height;
    if !(low.is_finite() && high.is_finite() && low <= high) {
        let value = format!("[{low}, {high}]");
        let rule = "must be two finite heights, the lower first";
        return Err(RegionError::BadNumber { key: "region.eye_height", value, rule });
    }
    let rectangles = spec.rectangles.iter().enumerate().map(|(k, &[x0, z0, x1, z1])| {
        (format!("rectangle {k}"), vec![[x0, z0], [x1, z0], [x1, z1], [x0, z1]])
    });
    let polygons =
        spec.polygons.iter().enumerate().map(|(k, p)| (format!("polygon {k}"), p.clone()));
    let all: Vec<(String, Polygon)> = rectangles.chain(polygons).collect();
    if all.is_empty() {
        return Err(RegionError::Empty);
    }
    all.into_iter()
        .map(|(shape, polygon)| {
            let sound = polygon.iter().flatten().all(|v| v.is_finite()) && area(&polygon) != 0.0;
            if sound { Ok(polygon) } else { Err(RegionError::BadShape { shape }) }
        })
        .collect()
}

fn name_patterns(patterns: &[String]) -> Result<GlobSet, RegionError> {
    let mut builder = GlobSetBuilder::new();
    for pattern in patterns {
        let glob = Glob::new(pattern).map_err(|e| RegionError::BadPattern {
            pattern: pattern.clone(),
            message: e.kind().to_string(),
        })?;
        builder.add(glob);
    }
    builder.build().map_err(|e| RegionError::BadPattern {
        pattern: patterns.join(", "),
        message: e.to_string(),
    })
}

/// World y of the ground below points of the plane.
struct Ground<'a> {
    scene: &'a Scene,
    start: f64,
    is_ground: Vec<bool>,
    /// False when everything is called ground.
    is_told_apart: bool,
}

impl<'a> Ground<'a> {
    fn new(scene: &'a Scene, from: Option<f64>, names: &[String]) -> Result<Self, RegionError> {
        let patterns = name_patterns(names)?;
        let is_ground: Vec<bool> =
            scene.objects.iter().map(|o| patterns.is_match(&o.name)).collect();
        if !is_ground.contains(&true) {
            return Err(RegionError::NoGround { patterns: names.to_vec() });
        }
        let start = from.unwrap_or(scene.geometry.bounds.max.y + 1.0);
        let is_told_apart = is_ground.contains(&false);
        Ok(Self { scene, start, is_ground, is_told_apart })
    }

    fn below(&self, caster: &mut RayCaster, x: f64, z: f64) -> Option<f64> {
        let geometry = &self.scene.geometry;
        let ray = Ray::new(DVec3::new(x, self.start, z), -DVec3::Y);
        let is_ground = |p: PrimitiveId| {
            let Place::Triangle(instance, _) = geometry.place(p) else { return false };
            self.is_ground[geometry.instances[instance.index()].object.index()]
        };
        let hit = caster.closest_occluder(geometry, ray, f64::INFINITY, is_ground)?;
        Some(self.start - hit.distance)
    }
}

/// Directions of the solid test: a fixed bundle in all octants, off the axes and planes that
/// buildings are aligned with. Lengths differ, which a ray does not mind.
fn bundle() -> impl Iterator<Item = DVec3> {
    let steps = || -2i32..=2;
    steps()
        .flat_map(move |x| steps().flat_map(move |y| steps().map(move |z| [x, y, z])))
        .filter(|d| d.iter().any(|v| v.abs() == 2))
        .map(|d| {
            let [x, y, z] = d.map(f64::from);
            DVec3::new(x + 0.071 * y + 0.013, y - 0.053 * z + 0.029, z + 0.037 * x - 0.017)
        })
}

/// True when the cell lies inside a solid. See the module's description.
fn is_inside_solid(
    scene: &Scene,
    cell: &ViewCell,
    ground: Option<&Ground<'_>>,
    caster: &mut RayCaster,
) -> bool {
    let geometry = &scene.geometry;
    let origin = cell.center();
    let (mut backs, mut rays) = (0, 0);
    for direction in bundle() {
        rays += 1;
        let ray = Ray::new(origin, direction);
        let Some(hit) = caster.closest_occluder(geometry, ray, f64::INFINITY, |_| true) else {
            return false;
        };
        // A particle is no solid that a cell can be shut in.
        let Some(instance) = hit.instance else { return false };
        let object = geometry.instances[instance.index()].object;
        if !hit.front && !scene.instances[instance.index()].double_sided {
            backs += 1;
        } else if !ground.is_some_and(|g| g.is_told_apart && g.is_ground[object.index()]) {
            return false;
        }
    }
    2 * backs > rays && primitives_in_cell(geometry, cell).is_empty()
}

/// Cuts a region into cells. Deterministic; runs on the current rayon pool.
///
/// # Errors
/// When the region is empty or makes no sense, or nothing is called ground.
pub fn tile(scene: &Scene, spec: &RegionSpec) -> Result<TiledRegion, RegionError> {
    let shapes = shapes(spec)?;
    let points = || shapes.iter().flatten();
    let low = [0, 1].map(|k| points().fold(f64::INFINITY, |m, p| m.min(p[k])));
    let high = [0, 1].map(|k| points().fold(f64::NEG_INFINITY, |m, p| m.max(p[k])));
    let size = spec.cell_size;
    // A region of 489.0000000001 m is 49 cells of 10 m, not 50.
    let count = [0, 1].map(|k| ((high[k] - low[k]) / size - 1e-9).ceil().max(1.0));
    if count[0] * count[1] > SQUARES_MAX {
        return Err(RegionError::TooManyCells { squares: count[0] * count[1], cell_size: size });
    }
    let [columns, rows] = count.map(|n| n as u32);
    let at = |axis: usize, k: u32| low[axis] + size * f64::from(k);

    let mut squares: Vec<[u32; 2]> = (0..rows)
        .flat_map(|j| (0..columns).map(move |i| [i, j]))
        .filter(|&[i, j]| {
            let (from, to) = ([at(0, i), at(1, j)], [at(0, i + 1), at(1, j + 1)]);
            shapes.iter().any(|s| meets(s, from, to))
        })
        .collect();
    let mut skipped = BTreeMap::new();
    let mut skip = |reason: &str, number: usize| {
        if number > 0 {
            *skipped.entry(reason.to_owned()).or_insert(0) += number as u64;
        }
    };
    skip("outside the region", columns as usize * rows as usize - squares.len());
    squares.sort_by_key(|&[i, j]| fast_hilbert::xy2h(i, j, 32));

    let ground = match &spec.heights {
        Heights::Absolute => None,
        Heights::AboveGround { from, ground } => Some(Ground::new(scene, *from, ground)?),
    };
    let mut nodes: Vec<[u32; 2]> = squares
        .iter()
        .flat_map(|&[i, j]| [[i, j], [i + 1, j], [i + 1, j + 1], [i, j + 1]])
        .collect();
    nodes.sort_unstable();
    nodes.dedup();
    let eyes: HashMap<[u32; 2], Option<DVec3>> = nodes
        .into_par_iter()
        .map_init(RayCaster::new, |caster, [i, j]| {
            let (x, z) = (at(0, i), at(1, j));
            let base = ground.as_ref().map_or(Some(0.0), |g| g.below(caster, x, z));
            ([i, j], base.map(|y| DVec3::new(x, y + spec.eye_height[0], z)))
        })
        .collect();

    let total = squares.len();
    let standing: Vec<(ViewCell, [i32; 2])> = squares
        .into_iter()
        .filter_map(|[i, j]| {
            let corners = [[i, j], [i + 1, j], [i + 1, j + 1], [i, j + 1]].map(|n| eyes[&n]);
            let [Some(a), Some(b), Some(c), Some(d)] = corners else { return None };
            let height = spec.eye_height[1] - spec.eye_height[0];
            let cell = ViewCell { id: CellId(0), corners: [a, b, c, d], height };
            Some((cell, [i as i32, j as i32]))
        })
        .collect();
    skip("no ground below", total - standing.len());

    let total = standing.len();
    let mut cells: Vec<(ViewCell, [i32; 2])> = standing
        .into_par_iter()
        .map_init(RayCaster::new, |caster, cell| {
            (!is_inside_solid(scene, &cell.0, ground.as_ref(), caster)).then_some(cell)
        })
        .flatten()
        .collect();
    skip("inside a solid", total - cells.len());
    for (number, (cell, _)) in cells.iter_mut().enumerate() {
        cell.id = CellId(number as u32);
    }
    Ok(TiledRegion { cells, skipped })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn squares_that_only_touch_a_shape_do_not_meet_it() {
        let triangle = vec![[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]];
        assert!(meets(&triangle, [0.0, 0.0], [1.0, 1.0]));
        assert!(meets(&triangle, [4.0, 4.0], [6.0, 6.0]));
        assert!(!meets(&triangle, [5.0, 5.0], [6.0, 6.0]));
        assert!(!meets(&triangle, [-1.0, 0.0], [0.0, 1.0]));
    }

    #[test]
    fn the_bundle_looks_into_every_octant() {
        for octant in 0..8 {
            let sign = |bit: i32| if octant >> bit & 1 == 1 { 1.0 } else { -1.0 };
            let s = DVec3::new(sign(0), sign(1), sign(2));
            assert!(bundle().any(|d| (d * s).min_element() > 0.5));
        }
    }
}
