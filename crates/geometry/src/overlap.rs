//! Triangles that reach into a view cell.
//!
//! A triangle with a point in a cell's interior is visible from viewpoints of the cell as close to
//! it as one likes, so it belongs to the cell's visible set whatever the segments on the perimeter
//! see of it.
//!
//! What moves is taken more loosely: in a state a triangle sweeps at most the convex hull of its six
//! corners, a particle at most the box of its two. Both count unless one of the planes that bound the
//! cell has them on its outer side, so nothing that reaches in is left out, and some of what passes
//! close by is in.

use std::ops::Range;

use glam::DVec3;

use crate::{
    Bounds, InstancedGeometry, MovingLevel, ParticleSystem, PrimitiveSet, StateSets, TopLevel,
    ViewCell,
};

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

/// For each side of the footprint, how far inside of it a point is, times the side's length: positive
/// inside.
fn sides(cell: &ViewCell) -> [impl Fn(DVec3) -> f64 + use<>; 4] {
    // Either orientation of the footprint: the signed area tells which side is inside.
    let c = cell.corners;
    let cross =
        |a: DVec3, b: DVec3, p: DVec3| (b.x - a.x) * (p.z - a.z) - (b.z - a.z) * (p.x - a.x);
    let turn = (cross(c[0], c[1], c[2]) + cross(c[0], c[2], c[3])).signum();
    [0, 1, 2, 3].map(|k| {
        let (a, b) = (c[k], c[(k + 1) % 4]);
        move |p: DVec3| turn * cross(a, b, p)
    })
}

/// True when the triangle has a point in the open interior of the cell. A cell of no height has
/// no interior.
#[must_use]
pub fn reaches_into(cell: &ViewCell, corners: [DVec3; 3]) -> bool {
    let mut polygon = corners.to_vec();
    for inside in sides(cell) {
        polygon = clip(&polygon, &inside);
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
        geometry.look();
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

/// What reaches into the cell in each of `states`.
///
/// # Panics
/// Without a state.
#[must_use]
pub fn primitives_in_cell_over(
    geometry: &InstancedGeometry,
    cell: &ViewCell,
    states: Range<u32>,
) -> StateSets {
    let resting = primitives_in_cell(geometry, cell);
    let slab = Slab::of(cell);
    let near = movers_near(geometry, cell, &states);
    if near.is_empty() {
        return StateSets::constant(states, resting);
    }
    StateSets::from_runs(states.map(|state| {
        let mut found: Vec<u32> = near
            .iter()
            .flat_map(|mover| mover.primitives_in(geometry, cell, &slab, state))
            .collect();
        found.sort_unstable();
        (state..state + 1, PrimitiveSet::union([&resting, &PrimitiveSet::from_sorted(found)]))
    }))
}

/// Something that may reach into a cell at some time.
enum Mover<'a> {
    /// Triangles of an instance.
    Instance(usize, Vec<usize>),
    /// Particles of a system.
    Particles(&'a ParticleSystem, Vec<usize>),
}

/// What moves, and all particles, near a cell in a window of states: by the volumes of their
/// hierarchies, or all triangles of an instance that moves as a whole.
fn movers_near<'a>(
    geometry: &'a InstancedGeometry,
    cell: &ViewCell,
    states: &Range<u32>,
) -> Vec<Mover<'a>> {
    let bounds = cell.bounds();
    let relative = |to: DVec3| Bounds { min: bounds.min - to, max: bounds.max - to };
    let mut near = Vec::new();
    for level in [&geometry.moving_occluders, &geometry.moving_see_through] {
        let MovingLevel { hierarchy, instances } = level;
        hierarchy.items_in(states, relative(geometry.origin), |item| {
            let id = instances[item].index();
            let mesh = &geometry.meshes[geometry.instances[id].mesh.index()];
            near.push(Mover::Instance(id, (0..mesh.triangles.len()).collect()));
        });
    }
    for system in &geometry.particles {
        let mut found = Vec::new();
        system.hierarchy.items_in(states, relative(system.origin), |item| found.push(item));
        if !found.is_empty() {
            near.push(Mover::Particles(system, found));
        }
    }
    near
}

impl Mover<'_> {
    /// Global numbers of those that reach into the cell in a state.
    fn primitives_in(
        &self,
        geometry: &InstancedGeometry,
        cell: &ViewCell,
        slab: &Slab,
        state: u32,
    ) -> Vec<u32> {
        match self {
            Self::Instance(id, triangles) => {
                let instance = &geometry.instances[*id];
                let mesh = &geometry.meshes[instance.mesh.index()];
                let maps = instance.around(state);
                let swept = mesh
                    .bounds_at(state)
                    .transformed(maps.0)
                    .union(mesh.bounds_at(state + 1).transformed(maps.1));
                if !swept.intersects(cell.bounds()) {
                    return Vec::new();
                }
                let reaches = |t: &&usize| {
                    let [from, to] = instance.corners_around(mesh, **t, state);
                    if from == to {
                        return reaches_into(cell, from);
                    }
                    let hull = [from, to].concat();
                    !slab.separates(cell, &hull)
                };
                let number = |t: &usize| instance.first_primitive.0 + *t as u32;
                triangles.iter().filter(reaches).map(number).collect()
            }
            Self::Particles(system, particles) => {
                let reaches = |p: &&usize| {
                    system.around(**p, state).is_some_and(|(from, to)| {
                        let swept = from.bounds().union(&to.bounds()).widen();
                        let corner = |k: usize| {
                            let pick = |axis: usize| {
                                if k >> axis & 1 == 1 { swept.max[axis] } else { swept.min[axis] }
                            };
                            system.origin + DVec3::new(pick(0), pick(1), pick(2))
                        };
                        let corners: Vec<DVec3> = (0..8).map(corner).collect();
                        !slab.separates(cell, &corners)
                    })
                };
                let number = |p: &usize| system.first_primitive.0 + *p as u32;
                particles.iter().filter(reaches).map(number).collect()
            }
        }
    }
}

/// Two parallel planes that hold a cell between them.
///
/// The lower surface is bilinear over the footprint: with the mean m of the corners' heights, the mean
/// slopes a and b, and the twist w = c0 - c1 + c2 - c3, it is m + a (u - 1/2) + b (v - 1/2) + w (u -
/// 1/2)(v - 1/2), whose last term is at most |w| / 4 either way.
struct Slab {
    low: Bounds,
    mean: f64,
    slopes: [f64; 2],
    twist: f64,
    height: f64,
}

impl Slab {
    fn of(cell: &ViewCell) -> Self {
        let [a, b, c, d] = cell.corners.map(|p| p.y);
        Self {
            low: Bounds::of_points(cell.corners),
            mean: (a + b + c + d) / 4.0,
            slopes: [((b + c) - (a + d)) / 2.0, ((c + d) - (a + b)) / 2.0],
            twist: (a - b + c - d).abs() / 4.0,
            height: cell.height,
        }
    }

    /// Height of a point over the middle one of the planes.
    fn over(&self, p: DVec3) -> f64 {
        let size = self.low.size();
        let share =
            |p: f64, low: f64, size: f64| if size > 0.0 { (p - low) / size - 0.5 } else { 0.0 };
        let (u, v) = (share(p.x, self.low.min.x, size.x), share(p.z, self.low.min.z, size.z));
        p.y - (self.mean + self.slopes[0] * u + self.slopes[1] * v)
    }

    /// True when one of the planes that bound the cell has the convex hull of `points` outside.
    fn separates(&self, cell: &ViewCell, points: &[DVec3]) -> bool {
        let all = |outside: &dyn Fn(DVec3) -> bool| points.iter().all(|&p| outside(p));
        sides(cell).iter().any(|inside| all(&|p| inside(p) <= 0.0))
            || all(&|p| self.over(p) <= -self.twist)
            || all(&|p| self.over(p) >= self.height + self.twist)
    }
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
    fn what_moves_counts_in_the_states_in_which_it_comes_by() {
        use crate::{Instance, Mesh, MeshId, ObjectId, ParticleSystem, PrimitiveId, Sphere};
        use glam::DAffine3;
        let corners = triangle(DVec3::ZERO, 0.1).map(|p| p.as_vec3().to_array());
        let (mesh, _) = Mesh::new(corners.to_vec(), &[[0, 1, 2]]);
        let at = |x: f64| DAffine3::from_translation(DVec3::new(x, 1.7, 1.0));
        let moved = Instance {
            mesh: MeshId(0),
            object: ObjectId(0),
            world_from_mesh: at(-9.0),
            first_primitive: PrimitiveId(0),
            occluder: true,
            // Outside, through, outside, and away.
            motion: Some(Box::new([at(-9.0), at(-2.0), at(5.0), at(9.0)])),
        };
        let sphere = |y: f32| vec![Sphere { center: [1.0, y, 1.0], radius: 0.1 }];
        let keys = vec![sphere(9.0), sphere(8.0), vec![Sphere::ABSENT], sphere(1.7)];
        let (system, _) = ParticleSystem::new(ObjectId(1), PrimitiveId(1), true, DVec3::ZERO, keys);
        let scene = InstancedGeometry::with_motion(vec![mesh], vec![moved], vec![system], 3);
        let found = primitives_in_cell_over(&scene, &cell(), 0..3);
        let set = |members: &[u32]| PrimitiveSet::from_sorted(members.iter().copied());
        // The particle is not there at the beginning of the last state.
        assert_eq!(found.runs(), [(0..1, set(&[])), (1..2, set(&[0])), (2..3, set(&[]))]);
        assert_eq!(found.within(1..2), primitives_in_cell_over(&scene, &cell(), 1..2));
        let stays = vec![Sphere { center: [1.0, 1.7, 1.0], radius: 0.1 }];
        let (system, _) =
            ParticleSystem::new(ObjectId(0), PrimitiveId(0), true, DVec3::ZERO, vec![stays]);
        let resting = InstancedGeometry::with_motion(vec![], vec![], vec![system], 1);
        assert_eq!(primitives_in_cell_over(&resting, &cell(), 0..1).at(0), &set(&[0]));
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
