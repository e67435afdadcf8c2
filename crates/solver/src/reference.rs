//! The exact twin: the definition itself, in rational arithmetic, with no culling and no floats.
//!
//! The floats of the input (mesh vertices, instance transforms, the frame's vectors and length,
//! rows and columns) are taken as the exact rationals that they are; everything after that is
//! exact. For each pixel it lists the stretch of t and the depth line of every cut, sorts all
//! ends and all crossings, and looks who is nearest in the middle of each gap between them; equal
//! depth goes to the lower primitive number. Slow on purpose: tests compare the fast solver with
//! it on small scenes.
//!
//! What moves, and spheres, have a twin of their own: [`motion`].

pub mod motion;

use dashu_ratio::RBig;
use glam::DVec3;
use sightline_geometry::{
    FACE_COUNT, Face, InstanceId, InstancedGeometry, RectifiedFrame, Sampling, ViewSegment,
};

/// A point or a vector, exact.
pub type V3 = [RBig; 3];

/// A stretch of a pixel's list, exact.
#[derive(Clone, Debug, PartialEq)]
pub struct ExactInterval {
    /// Start, in [0, 1).
    pub t0: RBig,
    /// End, in (0, 1].
    pub t1: RBig,
    /// The primitive that is nearest.
    pub primitive: u32,
}

/// What the definition says of one primitive: its longest interval at any pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// The primitive.
    pub primitive: u32,
    /// Length of its longest interval, units of t.
    pub longest: f64,
    /// Column coordinate c of the pixel that has it.
    pub column: f64,
    /// Share of (directions x segment) on which it is visible, when pixels are weighted by
    /// solid angle.
    pub weight: f64,
}

fn exact(v: f64) -> RBig {
    RBig::try_from(v).expect("scene and frame are finite")
}

fn exact3(v: DVec3) -> V3 {
    v.to_array().map(exact)
}

fn dot(a: &V3, b: &V3) -> RBig {
    &a[0] * &b[0] + &a[1] * &b[1] + &a[2] * &b[2]
}

/// A triangle in exact face coordinates.
struct FaceTriangle {
    corners: [V3; 3],
    primitive: u32,
    occluder: bool,
}

/// One cut at one column: t of its ends in ascending order, and the depths there.
struct Stretch {
    t: [RBig; 2],
    z: [RBig; 2],
    primitive: u32,
}

impl Stretch {
    fn depth(&self, t: &RBig) -> RBig {
        let share = (t - &self.t[0]) / (&self.t[1] - &self.t[0]);
        &self.z[0] + share * (&self.z[1] - &self.z[0])
    }

    fn covers(&self, t: &RBig) -> bool {
        &self.t[0] <= t && t < &self.t[1]
    }

    /// Where the depth lines of two stretches meet, if they do at one t.
    fn crossing(&self, other: &Self) -> Option<RBig> {
        let slope = |s: &Self| (&s.z[1] - &s.z[0]) / (&s.t[1] - &s.t[0]);
        let (a, b) = (slope(self), slope(other));
        if a == b {
            return None;
        }
        let at_zero = |s: &Self, slope: &RBig| &s.z[0] - slope * &s.t[0];
        Some((at_zero(other, &b) - at_zero(self, &a)) / (a - b))
    }
}

fn face_triangles(geometry: &InstancedGeometry, v0: DVec3, face: &Face) -> Vec<FaceTriangle> {
    let rows = [exact3(face.axis), exact3(face.up), exact3(face.forward)];
    let v0 = exact3(v0);
    let mut out = Vec::new();
    for (number, instance) in geometry.instances.iter().enumerate() {
        let m = instance.world_from_mesh;
        let (x, y, z) =
            (exact3(m.matrix3.x_axis), exact3(m.matrix3.y_axis), exact3(m.matrix3.z_axis));
        let translation = exact3(m.translation);
        let mesh = &geometry.meshes[instance.mesh.index()];
        for (t, primitive) in geometry.primitives_of(InstanceId(number as u32)).enumerate() {
            let corners = mesh.corners(t).map(|p| {
                let p = exact3(p);
                let relative: V3 = std::array::from_fn(|k| {
                    &x[k] * &p[0] + &y[k] * &p[1] + &z[k] * &p[2] + &translation[k] - &v0[k]
                });
                std::array::from_fn(|k| dot(&rows[k], &relative))
            });
            out.push(FaceTriangle { corners, primitive, occluder: instance.occluder });
        }
    }
    out
}

/// The ends (x, z) of a triangle's cut with row w, z >= 0.
fn cut(corners: &[V3; 3], w: &RBig) -> Option<[(RBig, RBig); 2]> {
    let h: [RBig; 3] = std::array::from_fn(|k| &corners[k][1] - w * &corners[k][2]);
    let mut ends = Vec::new();
    for (i, j) in [(0, 1), (1, 2), (2, 0)] {
        if (h[i] >= RBig::ZERO) != (h[j] >= RBig::ZERO) {
            let lambda = &h[i] / (&h[i] - &h[j]);
            let mix = |k: usize| &corners[i][k] + &lambda * (&corners[j][k] - &corners[i][k]);
            ends.push((mix(0), mix(2)));
        }
    }
    let [mut a, mut b] = <[(RBig, RBig); 2]>::try_from(ends).ok()?;
    match (a.1 > RBig::ZERO, b.1 > RBig::ZERO) {
        (false, false) => return None,
        (true, true) => {}
        (a_in_front, _) => {
            let lambda = &a.1 / (&a.1 - &b.1);
            let x0 = &a.0 + lambda * (&b.0 - &a.0);
            *(if a_in_front { &mut b } else { &mut a }) = (x0, RBig::ZERO);
        }
    }
    Some([a, b])
}

fn stretch(ends: &[(RBig, RBig); 2], c: &RBig, length: &RBig, primitive: u32) -> Option<Stretch> {
    let time = |e: &(RBig, RBig)| (&e.0 - c * &e.1) / length;
    let (a, b) = (time(&ends[0]), time(&ends[1]));
    let (za, zb) = (ends[0].1.clone(), ends[1].1.clone());
    let (t, z) = if a <= b { ([a, b], [za, zb]) } else { ([b, a], [zb, za]) };
    let inside = t[0] < t[1] && t[0] < RBig::ONE && t[1] > RBig::ZERO;
    inside.then_some(Stretch { t, z, primitive })
}

/// Sorted elementary borders in [0, 1] of stretches: all ends and all crossings.
fn borders(stretches: &[Stretch]) -> Vec<RBig> {
    let mut out = vec![RBig::ZERO, RBig::ONE];
    for (i, a) in stretches.iter().enumerate() {
        out.extend(a.t.iter().cloned());
        out.extend(stretches[..i].iter().filter_map(|b| a.crossing(b)));
    }
    out.retain(|t| (RBig::ZERO..=RBig::ONE).contains(t));
    out.sort();
    out.dedup();
    out
}

/// The envelope of the occluders among `stretches`.
fn envelope(stretches: &[Stretch]) -> Vec<ExactInterval> {
    let mut out: Vec<ExactInterval> = Vec::new();
    for pair in borders(stretches).windows(2) {
        let middle = (&pair[0] + &pair[1]) / RBig::from(2);
        let nearest = stretches
            .iter()
            .filter(|s| s.covers(&middle))
            .min_by_key(|s| (s.depth(&middle), s.primitive));
        let Some(nearest) = nearest else { continue };
        match out.last_mut() {
            Some(last) if last.primitive == nearest.primitive && last.t1 == pair[0] => {
                last.t1 = pair[1].clone();
            }
            _ => out.push(ExactInterval {
                t0: pair[0].clone(),
                t1: pair[1].clone(),
                primitive: nearest.primitive,
            }),
        }
    }
    out
}

/// The stretches on which a see-through cut is not behind the occluders.
fn unhidden(line: &Stretch, occluders: &[Stretch]) -> Vec<(RBig, RBig)> {
    let mut cuts: Vec<RBig> = borders(occluders);
    cuts.extend(occluders.iter().filter_map(|o| line.crossing(o)));
    cuts.extend(line.t.iter().cloned());
    cuts.retain(|t| (RBig::ZERO..=RBig::ONE).contains(t) && *t >= line.t[0] && *t <= line.t[1]);
    cuts.sort();
    cuts.dedup();
    cuts.windows(2)
        .filter(|pair| {
            let middle = (&pair[0] + &pair[1]) / RBig::from(2);
            let depth = line.depth(&middle);
            occluders.iter().all(|o| !o.covers(&middle) || depth <= o.depth(&middle))
        })
        .map(|pair| (pair[0].clone(), pair[1].clone()))
        .collect()
}

/// Everything visible from a segment at the pixel centres of `sampling`, in order of primitive.
/// Exact; cubic in the triangles that meet at a pixel.
#[must_use]
pub fn solve_segment(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    sampling: Sampling,
) -> Vec<Seen> {
    let Some(frame) = RectifiedFrame::new(segment) else { return Vec::new() };
    let length = exact(frame.length);
    let mut seen: std::collections::BTreeMap<u32, Seen> = std::collections::BTreeMap::new();
    for face in 0..FACE_COUNT {
        let triangles = face_triangles(geometry, frame.v0, &frame.face(face));
        for row in 0..sampling.rows() {
            let w = sampling.row(row);
            let exact_w = exact(w);
            let cuts: Vec<_> = triangles
                .iter()
                .filter_map(|t| Some((cut(&t.corners, &exact_w)?, t.primitive, t.occluder)))
                .collect();
            for column in 0..sampling.columns() {
                let c = sampling.column(column);
                let exact_c = exact(c);
                let at_column = |occluder: bool| -> Vec<Stretch> {
                    cuts.iter()
                        .filter(|x| x.2 == occluder)
                        .filter_map(|x| stretch(&x.0, &exact_c, &length, x.1))
                        .collect()
                };
                let (occluders, others) = (at_column(true), at_column(false));
                let solid_angle = Sampling::solid_angle(
                    sampling.c(f64::from(column)),
                    sampling.c(f64::from(column) + 1.0),
                    sampling.w(f64::from(row)),
                    sampling.w(f64::from(row) + 1.0),
                );
                let mut note = |primitive: u32, t0: &RBig, t1: &RBig| {
                    let length = (t1 - t0).to_f64().value();
                    let s = seen.entry(primitive).or_insert(Seen {
                        primitive,
                        longest: 0.0,
                        column: c,
                        weight: 0.0,
                    });
                    s.weight += length * solid_angle / (4.0 * std::f64::consts::PI);
                    if length > s.longest {
                        (s.longest, s.column) = (length, c);
                    }
                };
                for interval in envelope(&occluders) {
                    note(interval.primitive, &interval.t0, &interval.t1);
                }
                for line in &others {
                    for (t0, t1) in unhidden(line, &occluders) {
                        note(line.primitive, &t0, &t1);
                    }
                }
            }
        }
    }
    seen.into_values().collect()
}
