//! Deterministic benchmark scenes: a city, a town, a meadow at rest or in the wind as GLB files,
//! bouncing spheres as a particle table.
//!
//! The same kind, count and seed give the same bytes on every machine: numbers come from a fixed
//! generator (`random`), angles from the `libm` crate, JSON from structs with a fixed field order. Scenes are in metres, +Y up, with the ground at about y = 0 and the
//! suggested view region about the origin.
//!
//! - [`Kind::City`]: blocks on a grid. The street along z at x = 0 is straight over the whole city and
//!   20 m wide between the buildings (roadway |x| <= 7); so is the street along x at z = 0. Other streets
//!   are 10 to 30 m wide. Buildings are 10 to 200 m high, each a node `block_i_j/building_k`.
//! - [`Kind::Town`]: gabled houses along crooked streets, a church, a town wall, and trees of
//!   thousands of leaves. The street at x = 0 is straight and free for |x| <= 5.
//! - [`Kind::Grass`]: tufts and flowers on a rolling meadow through EXT_mesh_gpu_instancing.
//! - [`Kind::SwayingGrass`]: the same meadow in the wind: every blade and flower moves.
//! - [`bouncing_spheres`]: spheres that bounce on the plane y = 0 until they rest.
//!
//! Sizes of the source (Popescu et al., from-segment visibility, table 1 and section 4.2): city
//! 3.7 M, town 2.3 M, meadow 54.9 M triangles; 10,000 and 1,000,000 spheres over 25 states.
//!
//! Buildings, houses and furniture are made of closed solids (leaves, blades, petals and the
//! ground are single sheets); solids of one mesh may intersect, but never share an edge.

mod city;
mod facade;
mod glb_writer;
mod grass;
mod material;
mod random;
mod solid;
mod spheres;
mod town;
mod vegetation;

use std::io::{self, Write};
use std::ops::RangeInclusive;

use sightline_geometry::Bounds;

use crate::particles::WriteError;
use glb_writer::Document;
pub use spheres::{SPHERES_RANGE, bouncing_spheres};

/// States that a moving scene can be generated with.
pub const STATES_RANGE: RangeInclusive<u32> = 1..=1000;

/// The scenes that can be generated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Blocks of tall buildings on a grid of streets.
    City,
    /// Small gabled houses along crooked streets, with trees.
    Town,
    /// A meadow of instanced grass and flowers.
    Grass,
    /// The same meadow in the wind.
    SwayingGrass {
        /// States, in [`STATES_RANGE`]: the file has one key frame more.
        states: u32,
    },
}

impl Kind {
    /// Triangle counts that the kind can be generated with.
    #[must_use]
    pub const fn triangle_range(self) -> RangeInclusive<u64> {
        match self {
            Self::City => 20_000..=40_000_000,
            Self::Town => 50_000..=6_000_000,
            Self::Grass | Self::SwayingGrass { .. } => 20_000..=100_000_000,
        }
    }

    /// The name of the kind, lower case.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::City => "city",
            Self::Town => "town",
            Self::Grass => "grass",
            Self::SwayingGrass { .. } => "swaying-grass",
        }
    }
}

/// What was generated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GenerateReport {
    /// Triangles of the scene, counted once for every instance.
    pub triangles: u64,
    /// Triangles in the file.
    pub unique_triangles: u64,
    /// Spheres of the scene.
    pub particles: u64,
    /// States of the scene; 1 at rest.
    pub states: u32,
    /// Size of the file.
    pub bytes: u64,
    /// World box of the scene (of the boxes of its meshes) at all times, metres.
    pub bounds: Bounds,
    /// A rectangle to stand in: [x0, z0, x1, z1], metres. Free of obstacles but for spheres.
    pub suggested_region: [f64; 4],
    /// Lowest and highest eye height above the ground that suit the region, metres.
    pub suggested_eye_height: [f64; 2],
}

/// Why a scene was not generated.
#[derive(Debug, thiserror::Error)]
pub enum GenerateError {
    /// The kind cannot be generated in this size: ask for another count.
    #[error("a {} has {} to {} triangles, not {requested}", kind.name(), kind.triangle_range().start(),
        kind.triangle_range().end())]
    Size {
        /// The kind asked for.
        kind: Kind,
        /// The triangle count asked for.
        requested: u64,
    },
    /// So many spheres cannot be generated: ask for another count.
    #[error("bouncing spheres are {} to {}, not {requested}", SPHERES_RANGE.start(), SPHERES_RANGE.end())]
    Spheres {
        /// The count asked for.
        requested: u64,
    },
    /// So many states cannot be generated: ask for another number.
    #[error("a moving scene has {} to {} states, not {requested}", STATES_RANGE.start(),
        STATES_RANGE.end())]
    States {
        /// The number asked for.
        requested: u32,
    },
    /// The file could not be written.
    #[error("cannot write the scene")]
    Write(#[from] io::Error),
    /// The table could not be written.
    #[error("cannot write the table")]
    Table(#[from] WriteError),
}

/// A scene that is ready to be written.
struct Made {
    document: Document,
    suggested_region: [f64; 4],
    suggested_eye_height: [f64; 2],
}

/// A tessellated sphere of radius 1: vertices and 80 triangles.
pub(crate) fn unit_sphere() -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let mut sphere = solid::Solid::new();
    sphere.blob(material::Material::Lamp, glam::DVec3::ZERO, |_| 1.0);
    let triangles = sphere.parts.into_iter().flat_map(|part| part.triangles).collect();
    (sphere.positions, triangles)
}

fn check_states(states: u32) -> Result<(), GenerateError> {
    if STATES_RANGE.contains(&states) {
        Ok(())
    } else {
        Err(GenerateError::States { requested: states })
    }
}

/// Generates a scene of about `triangles` triangles (within 2 %) and writes it as GLB.
///
/// # Errors
/// [`GenerateError::Size`] for a count outside [`Kind::triangle_range`],
/// [`GenerateError::States`] for states outside [`STATES_RANGE`], [`GenerateError::Write`] when
/// `out` fails.
pub fn generate(
    kind: Kind,
    triangles: u64,
    seed: u64,
    out: &mut impl Write,
) -> Result<GenerateReport, GenerateError> {
    if !kind.triangle_range().contains(&triangles) {
        return Err(GenerateError::Size { kind, requested: triangles });
    }
    let states = match kind {
        Kind::City | Kind::Town | Kind::Grass => 1,
        Kind::SwayingGrass { states } => states,
    };
    check_states(states)?;
    let made = match kind {
        Kind::City => city::make(triangles, seed),
        Kind::Town => town::make(triangles, seed),
        Kind::Grass => grass::make(triangles, seed, None),
        Kind::SwayingGrass { states } => grass::make(triangles, seed, Some(states)),
    };
    let generator = format!("sightline generate {}", kind.name());
    let written = made.document.write(generator, out)?;
    Ok(GenerateReport {
        triangles: written.triangles,
        unique_triangles: written.unique_triangles,
        particles: 0,
        states,
        bytes: written.bytes,
        bounds: written.bounds,
        suggested_region: made.suggested_region,
        suggested_eye_height: made.suggested_eye_height,
    })
}
