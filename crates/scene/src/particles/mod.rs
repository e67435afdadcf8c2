//! Particle tables: spheres with radius, centre and key frame from Parquet or CSV.
//!
//! The format is `schemas/particles-v1.md`; why it is one of our own, and a table, is
//! `docs/adr/0012-particle-tables.md`.
//!
//! A table is read twice, row by row. The first time finds the particles, the key frames and the
//! box; the second time writes the spheres where they belong, relative to the middle of the box, so
//! that `f32` is fine enough far from the world's origin. So memory is 16 bytes a particle and key
//! frame, a few bytes a particle, and one batch of rows, never the table.
//!
//! Invariants:
//! - particles are in ascending order of the author's numbers until their hierarchy is built, so
//!   that the order of the rows within a key frame changes nothing;
//! - every particle is there at one key frame at least, and every key frame has a particle;
//! - nothing is kept for what the limit on spheres does not allow: particles times key frames are
//!   counted before memory is reserved.
//!
//! Parts: `rows` parses; `reach` makes balls of rows that say how far a particle may stray; `key_times`
//! brings tables and animations to the same key frames; `problem` says what is wrong; `table_writer`
//! writes tables.

mod key_times;
mod problem;
mod reach;
mod rows;
mod table_writer;

use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

use glam::DVec3;
use globset::GlobSet;
use sightline_geometry::{
    Bounds, InstancedGeometry, ObjectId, ParticleSystem, PrimitiveId, Sphere,
};

pub use key_times::{KEY_FRAMES_MAX, merge_key_times, resample};
pub use problem::{RowPlace, TableProblem};
pub use rows::TableFormat;
pub use table_writer::{TableWriter, WriteError};

use crate::{
    Cause, IngestReport, Object, OpenOptions, Scene, SceneDigest, SceneError, gltf_reader,
};
use reach::Reach;
use rows::{Row, Source};

/// Node of the objects that particle tables make: they have none.
pub const NO_NODE: u32 = u32::MAX;

/// Where the particles of a system come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParticleSource {
    /// The table.
    pub path: PathBuf,
    /// Our number of a particle in its system to the author's number of it.
    pub ids: Vec<u32>,
}

/// A particle table in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct ParticleTable {
    /// The file.
    pub path: PathBuf,
    /// World position that centres are relative to: the middle of the table's box.
    pub origin: DVec3,
    /// Times of its key frames, ascending, seconds.
    pub key_times: Vec<f64>,
    /// The spheres at each key frame.
    pub keys: Vec<Vec<Sphere>>,
    /// The author's numbers of the particles, ascending.
    pub ids: Vec<u32>,
    /// The most that is known of how each particle moves; empty where the rows are all that it does.
    reaches: Vec<Reach>,
    size: u64,
    hash: blake3::Hash,
}

/// Reads a table of at most `max_spheres` particles times key frames.
///
/// # Errors
/// When the file cannot be read, is no particle table or is too large; see [`TableProblem`].
pub fn read_table(path: &Path, max_spheres: u64) -> Result<ParticleTable, SceneError> {
    Source::open(path)
        .and_then(|source| read(path, &source, max_spheres))
        .map_err(|e| e.in_file(path))
}

fn read(path: &Path, source: &Source, max_spheres: u64) -> Result<ParticleTable, SceneError> {
    let format = TableFormat::of(path).ok_or(TableProblem::Format)?;
    let (size, hash) = source.hash()?;
    let mut survey = Survey { limit: max_spheres, ..Survey::default() };
    source.for_each_row(format, |row| survey.add(&row))?;
    if survey.bounds.is_empty() {
        return Err(TableProblem::Empty.into());
    }
    let Survey { particles, key_times, bounds, reaches: found, .. } = survey;
    let (ranks, ids) = particles.sorted();
    let mut reaches = found.clone();
    for (rank, reach) in ranks.iter().zip(found) {
        reaches[*rank as usize] = reach;
    }
    let mut filling = Filling {
        origin: bounds.center().round(),
        particles,
        ranks,
        keys: Vec::with_capacity(key_times.len()),
        key_frames: key_times.len(),
    };
    source.for_each_row(format, |row| filling.add(&row))?;
    if filling.keys.len() != key_times.len() {
        return Err(TableProblem::Changed.into());
    }
    let Filling { origin, keys, .. } = filling;
    let path = path.to_path_buf();
    Ok(ParticleTable { path, origin, key_times, keys, ids, reaches, size, hash })
}

/// Particles in order of their first rows, found by the author's numbers.
///
/// Writers keep an order from key frame to key frame, so the next row most often is of the particle that
/// followed before; only where it is not is the table of all particles asked.
#[derive(Default)]
struct Appearance {
    /// The author's numbers.
    ids: Vec<u32>,
    places: HashMap<u32, u32>,
    /// The particle behind the one that was found last.
    next: u32,
}

impl Appearance {
    fn find(&mut self, id: u32) -> Option<u32> {
        let expected = if self.next as usize == self.ids.len() { 0 } else { self.next };
        let found = match self.ids.get(expected as usize) {
            Some(own) if *own == id => expected,
            _ => *self.places.get(&id)?,
        };
        self.next = found + 1;
        Some(found)
    }

    /// Adds one that was not found.
    fn add(&mut self, id: u32) -> u32 {
        let place = self.ids.len() as u32;
        self.ids.push(id);
        self.places.insert(id, place);
        self.next = place + 1;
        place
    }

    /// For each, its place in the order of the author's numbers, and those numbers ascending.
    fn sorted(&self) -> (Vec<u32>, Vec<u32>) {
        let mut by_id: Vec<(u32, u32)> = self.ids.iter().copied().zip(0..).collect();
        by_id.sort_unstable();
        let mut ranks = vec![0; by_id.len()];
        for ((_, place), rank) in by_id.iter().zip(0..) {
            ranks[*place as usize] = rank;
        }
        (ranks, by_id.into_iter().map(|(id, _)| id).collect())
    }
}

/// What the first reading of a table finds.
struct Survey {
    particles: Appearance,
    /// The key frame at which a particle was seen last, by order of appearance.
    last_seen: Vec<u32>,
    /// What the rows say of each, by order of appearance; empty where they say nothing.
    reaches: Vec<Reach>,
    key_times: Vec<f64>,
    /// World box of all spheres at all key frames.
    bounds: Bounds,
    limit: u64,
}

impl Default for Survey {
    fn default() -> Self {
        Self {
            particles: Appearance::default(),
            last_seen: Vec::new(),
            reaches: Vec::new(),
            key_times: Vec::new(),
            bounds: Bounds::EMPTY,
            limit: 0,
        }
    }
}

impl Survey {
    fn add(&mut self, row: &Row) -> Result<(), TableProblem> {
        self.enter_key_frame(row)?;
        let number = match self.particles.find(row.particle) {
            None => {
                self.last_seen.push(row.state);
                self.particles.add(row.particle)
            }
            Some(number) => {
                let last = std::mem::replace(&mut self.last_seen[number as usize], row.state);
                if last == row.state {
                    let (place, particle, state) = (row.place, row.particle, row.state);
                    return Err(TableProblem::Twice { place, particle, state });
                }
                number
            }
        };
        if let Some(reach) = row.reach {
            match self.reaches.get_mut(number as usize) {
                Some(before) => *before = before.or_looser(reach),
                None => self.reaches.push(reach),
            }
        }
        let count = self.last_seen.len() as u64 * self.key_times.len() as u64;
        if count > self.limit {
            return Err(TableProblem::TooManySpheres { count, limit: self.limit });
        }
        let (center, radius) = (row.center, row.radius);
        self.bounds = self.bounds.union(Bounds { min: center - radius, max: center + radius });
        Ok(())
    }

    /// Checks that the rows come key frame by key frame, and when.
    fn enter_key_frame(&mut self, row: &Row) -> Result<(), TableProblem> {
        let (place, state) = (row.place, row.state);
        let time = row.time.unwrap_or(f64::from(state));
        let wrong_time = |other, rule| Err(TableProblem::Time { place, time, other, rule });
        let known = self.key_times.len();
        match (state as usize, self.key_times.last()) {
            (now, Some(&other)) if now + 1 == known => {
                if time != other {
                    return wrong_time(other, "all rows of a key frame have the same time");
                }
            }
            (now, last) if now == known => {
                if let Some(&other) = last.filter(|&&other| time <= other) {
                    return wrong_time(other, "later key frames have later times");
                }
                if known >= KEY_FRAMES_MAX {
                    let (count, limit) = (known as u64 + 1, KEY_FRAMES_MAX as u64);
                    return Err(TableProblem::TooManyKeyFrames { count, limit });
                }
                self.key_times.push(time);
            }
            _ => {
                let previous = known.checked_sub(1).map(|k| k as u32);
                return Err(TableProblem::Order { place, state, previous });
            }
        }
        Ok(())
    }
}

/// What the second reading of a table fills.
struct Filling {
    origin: DVec3,
    particles: Appearance,
    /// Our numbers, by order of appearance.
    ranks: Vec<u32>,
    keys: Vec<Vec<Sphere>>,
    /// Key frames of the first reading.
    key_frames: usize,
}

impl Filling {
    fn add(&mut self, row: &Row) -> Result<(), TableProblem> {
        if row.state as usize == self.keys.len() && self.keys.len() < self.key_frames {
            self.keys.push(vec![Sphere::ABSENT; self.ranks.len()]);
        }
        // The rows were sound when they were read before.
        let found = self.particles.find(row.particle).ok_or(TableProblem::Changed)?;
        let number = self.ranks[found as usize];
        let spheres = self.keys.get_mut(row.state as usize).ok_or(TableProblem::Changed)?;
        let center = (row.center - self.origin).as_vec3().to_array();
        spheres[number as usize] = Sphere { center, radius: row.radius as f32 };
        Ok(())
    }
}

/// The tables of a scene, before they have numbers.
#[derive(Default)]
pub(crate) struct Tables {
    tables: Vec<ParticleTable>,
    max_spheres: u64,
}

/// Tables as parts of a scene, each list with one entry a table.
pub(crate) struct PlacedTables {
    pub(crate) systems: Vec<ParticleSystem>,
    pub(crate) objects: Vec<Object>,
    pub(crate) sources: Vec<ParticleSource>,
}

impl Tables {
    /// Reads the tables that the options add.
    pub(crate) fn read(options: &OpenOptions) -> Result<Self, SceneError> {
        let mut tables = Self { tables: Vec::new(), max_spheres: options.max_spheres };
        for path in &options.particles {
            let read = |limit| read_table(path, limit);
            tables.add(read)?;
        }
        Ok(tables)
    }

    fn add(
        &mut self,
        read: impl FnOnce(u64) -> Result<ParticleTable, SceneError>,
    ) -> Result<(), SceneError> {
        let spheres = |t: &ParticleTable| t.ids.len() as u64 * t.key_times.len() as u64;
        let held: u64 = self.tables.iter().map(spheres).sum();
        self.tables.push(read(self.max_spheres - held)?);
        Ok(())
    }

    /// Key times of each table.
    pub(crate) fn key_times(&self) -> Vec<&[f64]> {
        self.tables.iter().map(|table| table.key_times.as_slice()).collect()
    }

    /// Name, size and hash of each file. The name has no folder, so that a scene keeps its digest
    /// when its tables are elsewhere.
    pub(crate) fn files(&self) -> Vec<(String, u64, blake3::Hash)> {
        self.tables.iter().map(|t| (file_name(&t.path), t.size, t.hash)).collect()
    }

    /// Turns the tables into systems with the key frames of the scene, numbered behind what is there.
    pub(crate) fn place(
        self,
        key_times: &[f64],
        first_object: u32,
        first_primitive: u32,
        see_through: &GlobSet,
    ) -> Result<PlacedTables, SceneError> {
        self.check_counts(key_times.len() as u64, first_primitive)?;
        let mut placed =
            PlacedTables { systems: Vec::new(), objects: Vec::new(), sources: Vec::new() };
        let mut next = first_primitive;
        for (table, number) in self.tables.into_iter().zip(first_object..) {
            let name = table.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            // A ball that holds a particle is not all particle.
            let occluder = table.reaches.is_empty() && !see_through.is_match(&name);
            let keys = if table.reaches.is_empty() {
                resample(&table.key_times, table.keys, key_times)
            } else {
                balls(&table.key_times, table.keys, key_times, &table.reaches, &table.ids)
                    .map_err(|problem| SceneError::from(problem).in_file(&table.path))?
            };
            let id = ObjectId(number);
            let (system, order) =
                ParticleSystem::new(id, PrimitiveId(next), occluder, table.origin, keys);
            let end = next + system.len() as u32;
            placed.objects.push(Object {
                id,
                path: name.clone(),
                name,
                node: NO_NODE,
                primitives: next..end,
                occluder,
                bounds: system.bounds,
            });
            placed.sources.push(ParticleSource {
                path: table.path,
                ids: order.into_iter().map(|i| table.ids[i as usize]).collect(),
            });
            placed.systems.push(system);
            next = end;
        }
        Ok(placed)
    }

    /// Refuses more key frames, spheres or primitives than a scene can have. Tables have more
    /// spheres at the key frames of the scene than at their own.
    fn check_counts(&self, key_frames: u64, first_primitive: u32) -> Result<(), SceneError> {
        if key_frames > KEY_FRAMES_MAX as u64 {
            let (count, limit) = (key_frames, KEY_FRAMES_MAX as u64);
            return Err(TableProblem::TooManyKeyFrames { count, limit }.into());
        }
        let (mut spheres, mut primitives) = (0, u64::from(first_primitive));
        for table in &self.tables {
            let particles = table.ids.len() as u64;
            primitives += particles;
            let rests = table.keys.len() == 1 && table.reaches.is_empty();
            spheres += particles * if rests { 1 } else { key_frames };
        }
        let limit = self.max_spheres;
        if spheres > limit {
            return Err(TableProblem::TooManySpheres { count: spheres, limit }.into());
        }
        let limit = u64::from(u32::MAX);
        if primitives > limit {
            return Err(Cause::TooManyPrimitives { count: primitives, limit }.into());
        }
        Ok(())
    }
}

/// The balls that hold particles at the key frames of a scene, among which are those of their rows.
fn balls(
    times: &[f64],
    rows: Vec<Vec<Sphere>>,
    key_times: &[f64],
    reaches: &[Reach],
    ids: &[u32],
) -> Result<Vec<Vec<Sphere>>, TableProblem> {
    // Of a table with one key frame nothing is said about when; it holds from the start.
    let times = if times.len() == 1 { &key_times[..1] } else { times };
    let mut rows = times.iter().zip(rows).peekable();
    let mut keys: Vec<Vec<Sphere>> = key_times
        .iter()
        .map(|time| {
            let here = rows.next_if(|(own, _)| *own == time);
            here.map_or_else(|| vec![Sphere::ABSENT; ids.len()], |(_, spheres)| spheres)
        })
        .collect();
    if let Err(found) = reach::grow(&mut keys, key_times, reaches) {
        let reach::TooFast { particle, from, distance, most } = found;
        return Err(TableProblem::TooFast { particle: ids[particle], from, distance, most });
    }
    for (particle, sphere) in keys.iter().flat_map(|spheres| ids.iter().zip(spheres)) {
        let radius = f64::from(sphere.radius);
        if radius > gltf_reader::MAX_COORDINATE {
            return Err(TableProblem::Strays { particle: *particle, radius });
        }
    }
    Ok(keys)
}

/// Reads a scene of particles alone.
pub(crate) fn read_scene(path: &Path, options: &OpenOptions) -> Result<Scene, SceneError> {
    scene(path, &Source::open(path)?, options)
}

/// Reads a scene of particles alone, whose main table is in memory.
pub(crate) fn read_scene_bytes(
    path: &Path,
    main: &[u8],
    options: &OpenOptions,
) -> Result<Scene, SceneError> {
    scene(path, &Source::Memory(bytes::Bytes::copy_from_slice(main)), options)
}

fn scene(path: &Path, source: &Source, options: &OpenOptions) -> Result<Scene, SceneError> {
    let see_through = gltf_reader::see_through_patterns(options)?;
    let mut tables = Tables { tables: Vec::new(), max_spheres: options.max_spheres };
    tables.add(|limit| read(path, source, limit))?;
    for path in &options.particles {
        tables.add(|limit| read_table(path, limit))?;
    }
    let digest = SceneDigest::of_files(tables.files());
    let key_times = merge_key_times(&tables.key_times());
    let placed = tables.place(&key_times, 0, 0, &see_through)?;
    let mut report = IngestReport { objects: placed.objects.len() as u64, ..Default::default() };
    report.count_particles(&placed.systems);
    Ok(Scene {
        geometry: InstancedGeometry::with_motion(
            Vec::new(),
            Vec::new(),
            placed.systems,
            states(&key_times),
        ),
        objects: placed.objects,
        meshes: Vec::new(),
        instances: Vec::new(),
        particles: placed.sources,
        key_times,
        report,
        digest,
        memory: None,
    })
}

/// States of a scene with these key frames: a scene at rest has one, though one key frame.
pub(crate) fn states(key_times: &[f64]) -> u32 {
    (key_times.len() as u32 - 1).max(1)
}

/// Names, sizes and hashes of tables.
pub(crate) fn files(paths: &[PathBuf]) -> Result<Vec<(String, u64, blake3::Hash)>, SceneError> {
    let hashed = |path: &PathBuf| {
        let (size, hash) =
            Source::open(path).and_then(|source| source.hash()).map_err(|e| e.in_file(path))?;
        Ok((file_name(path), size, hash))
    };
    paths.iter().map(hashed).collect()
}

/// True for a file that is opened as a particle table.
pub(crate) fn is_table(path: &Path) -> bool {
    TableFormat::of(path).is_some()
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}
