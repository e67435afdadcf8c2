//! Triangles that reach into a view cell.
//!
//! A triangle with a point in a cell's interior is visible from viewpoints of the cell as close to
//! it as one likes, so it belongs to the cell's visible set whatever the segments on the perimeter
//! see of it.

use glam::DVec3;

use crate::{Bounds, InstancedGeometry, PrimitiveSet, TopLevel, ViewCell};

/// The part of a polygon with `inside(p) >= 0`; `inside` is linear. Sutherland-Hodgman.
fn clip(polygon: &[DVec3], inside: impl Fn(DVec3) -> f64) -> Vec<DVec3> {
    let mut out = Vec::with_capacity(polygon.len() + 1);
    for (k, &p) in polygon.iter().enumerate() {
        let q = polygon[(k + 1) % polygon.len()];
        let (a, b) = (inside(p), inside(q));
        if a >= 0.0 {
            out.push(p);
        }
        if (a > 0.0 && b < 0.0) || (a < 0.0 && b > 0.0) {
            out.push(p + (q - p) * (a / (a - b)));
        }
    }
    out
}

/// True when the triangle has a point in the open interior of the cell. A cell of no height has
/// no interior.
#[must_use]
pub fn reaches_into(cell: &ViewCell, corners: [DVec3; 3]) -> bool {
    let mut polygon = corners.to_vec();
    // Either orientation of the footprint: the signed area tells which side is inside.
    let c = cell.corners;
    let cross =
        |a: DVec3, b: DVec3, p: DVec3| (b.x - a.x) * (p.z - a.z) - (b.z - a.z) * (p.x - a.x);
    let turn = (cross(c[0], c[1], c[2]) + cross(c[0], c[2], c[3])).signum();
    for k in 0..4 {
        let (a, b) = (c[k], c[(k + 1) % 4]);
        let inside = |p: DVec3| turn * cross(a, b, p);
        polygon = clip(&polygon, inside);
        if !polygon.iter().any(|&p| inside(p) > 0.0) {
            return false;
        }
    }
    // Height over the lower surface. It is linear along the polygon up to the bilinear twist, so
    // the signs at the corners decide.
    let (mut any_above_floor, mut any_below_ceiling) = (false, false);
    for p in polygon {
        let h = p.y - cell.floor_below(p);
        any_above_floor |= h > 0.0;
        any_below_ceiling |= h < cell.height;
    }
    any_above_floor && any_below_ceiling
}

/// The triangles that reach into the cell.
#[must_use]
pub fn primitives_in_cell(geometry: &InstancedGeometry, cell: &ViewCell) -> PrimitiveSet {
    let bounds = cell.bounds();
    let mut found = Vec::new();
    for top in [&geometry.occluders, &geometry.see_through] {
        collect(geometry, top, cell, bounds, &mut found);
    }
    found.sort_unstable();
    PrimitiveSet::from_sorted(found)
}

fn collect(
    geometry: &InstancedGeometry,
    top: &TopLevel,
    cell: &ViewCell,
    bounds: Bounds,
    found: &mut Vec<u32>,
) {
    let relative = Bounds { min: bounds.min - geometry.origin, max: bounds.max - geometry.origin };
    top.hierarchy.items_in(relative, |item| {
        let instance = &geometry.instances[top.instances[item].index()];
        let mesh = &geometry.meshes[instance.mesh.index()];
        let local = bounds.transformed(&instance.world_from_mesh.inverse());
        mesh.hierarchy.items_in(local, |t| {
            let corners = mesh.corners(t).map(|p| instance.world_from_mesh.transform_point3(p));
            if reaches_into(cell, corners) {
                found.push(instance.first_primitive.0 + t as u32);
            }
        });
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CellId;

    fn cell() -> ViewCell {
        let corner = |x: f64, z: f64| DVec3::new(x, 1.0 + 0.5 * x, z);
        let corners = [corner(0.0, 0.0), corner(2.0, 0.0), corner(2.0, 2.0), corner(0.0, 2.0)];
        ViewCell { id: CellId(0), corners, height: 0.5 }
    }

    fn triangle(at: DVec3, size: f64) -> [DVec3; 3] {
        [at, at + DVec3::new(size, 0.0, 0.0), at + DVec3::new(0.0, size, size)]
    }

    #[test]
    fn triangles_inside_across_and_aside_are_told_apart() {
        let inside = triangle(DVec3::new(1.0, 1.7, 1.0), 0.05);
        let below = triangle(DVec3::new(1.0, 1.2, 1.0), 0.05);
        let above = triangle(DVec3::new(1.0, 2.3, 1.0), 0.05);
        assert!(reaches_into(&cell(), inside));
        assert!(!reaches_into(&cell(), below));
        assert!(!reaches_into(&cell(), above));
        let through =
            [DVec3::new(1.0, -9.0, 1.0), DVec3::new(1.0, 9.0, 1.0), DVec3::new(1.0, 9.0, 1.5)];
        assert!(reaches_into(&cell(), through));
        let on_the_side = through.map(|p| DVec3::new(0.0, p.y, p.z));
        assert!(!reaches_into(&cell(), on_the_side));
        let large = [
            DVec3::new(-99.0, 1.6, -99.0),
            DVec3::new(99.0, 1.6, -99.0),
            DVec3::new(0.0, 1.6, 99.0),
        ];
        assert!(reaches_into(&cell(), large));
    }
}
