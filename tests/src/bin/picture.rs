//! Draws the pictures of the README: what a dataset means, seen from a street and from above.
//!
//! ```text
//! cargo run --release -p sightline-tests --bin picture -- SCENE DATASET CELL FOLDER
//! ```
//!
//! Writes three PNG files into FOLDER, all by casting rays through the scene:
//! - `street.png`: the view from the middle of the cell. Left the full scene, right only the
//!   cell's visible set: they should look alike.
//! - `visible-set.png`: the scene from above in grey, the visible set of the cell in colour.
//! - `cells.png`: the map of the view region, each cell in the colour of the size of its set.

use std::error::Error;
use std::f64::consts::TAU;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use glam::DVec3;
use rayon::prelude::*;
use sightline_geometry::raycast::RayCaster;
use sightline_geometry::{
    Bounds, CellId, Hit, InstancedGeometry, PrimitiveId, PrimitiveSet, Ray, ViewCell,
};
use sightline_quality::Members;
use sightline_scene::{OpenOptions, Scene};
use sightline_store::{BakeStore, CellRow, Dataset};

/// Rays a pixel, along each axis.
const SAMPLES: usize = 3;
/// Unit vector to the sun.
const SUN: DVec3 = DVec3::new(0.48, 0.80, 0.36);
const SKY: DVec3 = DVec3::new(0.70, 0.82, 0.95);
const GREY: DVec3 = DVec3::new(0.80, 0.80, 0.79);
const STONE: DVec3 = DVec3::new(0.86, 0.82, 0.76);
const SEEN: DVec3 = DVec3::new(0.96, 0.55, 0.16);
const MARK: DVec3 = DVec3::new(0.10, 0.35, 0.85);

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, dataset, cell, folder] = arguments.as_slice() else {
        return Err("give SCENE DATASET CELL FOLDER".into());
    };
    let scene = Scene::open(Path::new(scene), &OpenOptions::default())?;
    let rows = read_rows(dataset)?;
    let cell = CellId(cell.parse()?);
    let row = rows.iter().find(|r| r.cell.id == cell).ok_or("there is no such cell")?;
    let folder = PathBuf::from(folder);
    let painter = Painter { geometry: &scene.geometry };
    painter.street(row).write(&folder.join("street.png"))?;
    painter.bird_view(row).write(&folder.join("visible-set.png"))?;
    painter.map(&rows).write(&folder.join("cells.png"))?;
    Ok(())
}

fn read_rows(dataset: &str) -> Result<Vec<CellRow>, Box<dyn Error>> {
    let runtime = tokio::runtime::Runtime::new()?;
    runtime.block_on(async {
        let dataset = Dataset::open(&BakeStore::open(dataset)?).await?;
        let mut rows = Vec::new();
        for entry in dataset.cells() {
            rows.push(dataset.cell(entry.cell.id).await?);
        }
        Ok(rows)
    })
}

/// Linear colours, row by row from the top.
struct Image {
    width: usize,
    pixels: Vec<DVec3>,
}

impl Image {
    /// Calls `color(caster, x, y)` at the samples of every pixel; x and y are in pixels.
    fn paint(
        width: usize,
        height: usize,
        color: impl Fn(&mut RayCaster, f64, f64) -> DVec3 + Sync,
    ) -> Self {
        let row = |y: usize| {
            let mut caster = RayCaster::new();
            let pixel = |x: usize| average(|u, v| color(&mut caster, x as f64 + u, y as f64 + v));
            (0..width).map(pixel).collect::<Vec<_>>()
        };
        Self { width, pixels: (0..height).into_par_iter().flat_map_iter(row).collect() }
    }

    /// Puts two images side by side with a white gap.
    fn beside(&self, other: &Self, gap: usize) -> Self {
        let lines = self.pixels.chunks(self.width).zip(other.pixels.chunks(other.width));
        let join = |(a, b): (&[DVec3], &[DVec3])| [a, &vec![DVec3::ONE; gap], b].concat();
        Self { width: self.width + gap + other.width, pixels: lines.flat_map(join).collect() }
    }

    fn write(&self, path: &Path) -> Result<(), Box<dyn Error>> {
        let height = self.pixels.len() / self.width;
        let file = BufWriter::new(File::create(path)?);
        let mut encoder = png::Encoder::new(file, self.width as u32, height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_compression(png::Compression::High);
        // Gamma 2.2. Even values only: what nobody sees would double the file.
        let encode = |c: f64| (c.clamp(0.0, 1.0).powf(1.0 / 2.2) * 127.0).round() as u8 * 2;
        let bytes: Vec<u8> = self.pixels.iter().flat_map(|p| p.to_array().map(encode)).collect();
        encoder.write_header()?.write_image_data(&bytes)?;
        Ok(())
    }
}

fn average(mut color: impl FnMut(f64, f64) -> DVec3) -> DVec3 {
    let at = |k: usize| (k as f64 + 0.5) / SAMPLES as f64;
    let mut sum = DVec3::ZERO;
    for i in 0..SAMPLES * SAMPLES {
        sum += color(at(i % SAMPLES), at(i / SAMPLES));
    }
    sum / (SAMPLES * SAMPLES) as f64
}

/// A pinhole camera.
struct Camera {
    eye: DVec3,
    forward: DVec3,
    right: DVec3,
    up: DVec3,
}

impl Camera {
    /// `field` is the tangent of half the vertical field of view.
    fn new(eye: DVec3, target: DVec3, field: f64) -> Self {
        let forward = (target - eye).normalize();
        let right = forward.cross(DVec3::Y).normalize();
        Self { eye, forward, right: right * field, up: right.cross(forward) * field }
    }

    /// The ray of a point of the image; v is -1 at the bottom, 1 at the top, u likewise scaled.
    fn ray(&self, u: f64, v: f64) -> Ray {
        let direction = (self.forward + u * self.right + v * self.up).normalize();
        Ray::new(self.eye, direction)
    }
}

struct Painter<'a> {
    geometry: &'a InstancedGeometry,
}

impl Painter<'_> {
    fn nearest(
        &self,
        caster: &mut RayCaster,
        ray: Ray,
        accept: impl Fn(PrimitiveId) -> bool,
    ) -> Option<Hit> {
        let solid = caster.closest_occluder(self.geometry, ray, f64::INFINITY, &accept);
        let mut best = solid;
        let limit = solid.map_or(f64::INFINITY, |h| h.distance);
        caster.see_through(self.geometry, ray, limit, |hit| {
            if accept(hit.primitive) && best.is_none_or(|b| hit.distance < b.distance) {
                best = Some(hit);
            }
        });
        best
    }

    /// Light on a hit: the sun with its shadow, and the sky. `cast` says what throws shadows.
    fn light(
        &self,
        caster: &mut RayCaster,
        ray: Ray,
        hit: Hit,
        cast: impl Fn(PrimitiveId) -> bool,
    ) -> f64 {
        let [a, b, c] = self.geometry.triangle(hit.primitive).corners;
        let normal = (b - a).cross(c - a).normalize_or_zero();
        let normal = if normal.dot(ray.direction) > 0.0 { -normal } else { normal };
        let point = ray.origin + hit.distance * ray.direction + 1e-3 * normal;
        let sky = 0.34 + 0.16 * normal.y + 0.06 * normal.x;
        let facing = normal.dot(SUN.normalize());
        if facing <= 0.0 {
            return sky;
        }
        let to_sun = Ray::new(point, SUN);
        let shadow = caster.closest_occluder(self.geometry, to_sun, f64::INFINITY, &cast);
        if shadow.is_some() { sky } else { sky + 0.62 * facing }
    }

    fn street(&self, row: &CellRow) -> Image {
        let (width, height) = (480, 400);
        let eye = row.cell.center();
        let camera = Camera::new(eye, eye + self.widest_view(eye), 0.62);
        let members = Members::new(&row.set, self.geometry.primitive_count());
        let view = |accept: &(dyn Fn(PrimitiveId) -> bool + Sync)| {
            Image::paint(width, height, |caster, x, y| {
                let half = height as f64 / 2.0;
                let ray = camera.ray((x - width as f64 / 2.0) / half, (half - y) / half);
                match self.nearest(caster, ray, accept) {
                    None => SKY.lerp(DVec3::ONE, 1.0 - ray.direction.y.clamp(0.0, 1.0)),
                    // Shadows come from the full scene in both: a set holds what is seen, not
                    // what shades it.
                    Some(hit) => {
                        let haze = 1.0 - 0.5_f64.powf(hit.distance / 600.0);
                        let lit = STONE * self.light(caster, ray, hit, |_| true);
                        lit.lerp(SKY, haze)
                    }
                }
            })
        };
        view(&|_| true).beside(&view(&|p| members.contains(p)), 8)
    }

    /// The horizontal direction in which most can be seen, slightly upwards.
    fn widest_view(&self, eye: DVec3) -> DVec3 {
        let mut caster = RayCaster::new();
        let direction = |k: u32| {
            let angle = TAU * f64::from(k) / 64.0;
            DVec3::new(angle.cos(), 0.0, angle.sin())
        };
        let mut free = |k: u32| {
            let ray = Ray::new(eye, direction(k));
            caster
                .closest_occluder(self.geometry, ray, 2000.0, |_| true)
                .map_or(0.0, |h| h.distance)
        };
        let best = (0..64).max_by(|&a, &b| free(a).total_cmp(&free(b)));
        // A little to the side, so that a facade is in the picture.
        let ahead = direction(best.unwrap_or_default());
        (ahead + 0.25 * ahead.cross(DVec3::Y) + 0.18 * DVec3::Y).normalize()
    }

    fn bird_view(&self, row: &CellRow) -> Image {
        let (width, height) = (960, 540);
        let center = row.cell.center();
        let reach = seen_radius(self.geometry, &row.set, center).clamp(40.0, 400.0);
        let eye = center + reach * DVec3::new(0.55, 1.15, 1.35);
        let camera = Camera::new(eye, center - DVec3::Y * 0.05 * reach, 0.5);
        let members = Members::new(&row.set, self.geometry.primitive_count());
        Image::paint(width, height, |caster, x, y| {
            let half = height as f64 / 2.0;
            let ray = camera.ray((x - width as f64 / 2.0) / half, (half - y) / half);
            let Some(hit) = self.nearest(caster, ray, |_| true) else { return DVec3::ONE };
            let point = ray.origin + hit.distance * ray.direction;
            let color = if is_over(&row.cell, point) {
                MARK
            } else if members.contains(hit.primitive) {
                SEEN
            } else {
                GREY
            };
            color * self.light(caster, ray, hit, |_| true)
        })
    }

    fn map(&self, rows: &[CellRow]) -> Image {
        let region = rows.iter().fold(Bounds::EMPTY, |b, r| b.union(r.cell.bounds()));
        let (center, size) = (0.5 * (region.min + region.max), region.size());
        let (width, height) = (720, 540);
        let metres = 1.25 * (size.x / width as f64).max(size.z / height as f64);
        let top = self.geometry.bounds.max.y + 1.0;
        let largest = rows.iter().map(|r| r.set.len()).max().unwrap_or(1).max(1) as f64;
        let smallest = rows.iter().map(|r| r.set.len()).min().unwrap_or(0) as f64;
        Image::paint(width, height, |caster, x, y| {
            let ground =
                center + metres * DVec3::new(x - width as f64 / 2.0, 0.0, y - height as f64 / 2.0);
            let ray = Ray::new(DVec3::new(ground.x, top, ground.z), DVec3::NEG_Y);
            let Some(hit) = self.nearest(caster, ray, |_| true) else { return DVec3::ONE };
            let light = self.light(caster, ray, hit, |_| true);
            match rows.iter().find(|r| is_over(&r.cell, ground)) {
                None => GREY * light,
                Some(row) => {
                    let share = (row.set.len() as f64 - smallest) / (largest - smallest).max(1.0);
                    let border = border_distance(&row.cell, ground) < 0.8 * metres;
                    ramp(share) * if border { 0.55 } else { 0.45 + 0.6 * light }
                }
            }
        })
    }
}

/// Distance within which nine tenths of the set's triangles are, metres.
fn seen_radius(geometry: &InstancedGeometry, set: &PrimitiveSet, center: DVec3) -> f64 {
    let distance = |p: PrimitiveId| (geometry.triangle(p).corners[0] - center).length();
    let mut distances: Vec<f64> = set.iter().map(distance).collect();
    distances.sort_by(f64::total_cmp);
    distances.get(distances.len() * 9 / 10).copied().unwrap_or(100.0)
}

fn is_over(cell: &ViewCell, point: DVec3) -> bool {
    border_distance(cell, point) > 0.0
}

/// Distance to the border of the cell's box, seen from above; negative outside.
fn border_distance(cell: &ViewCell, point: DVec3) -> f64 {
    let b = cell.bounds();
    let (low, high) = (point - b.min, b.max - point);
    low.x.min(low.z).min(high.x).min(high.z)
}

/// From blue over yellow to red.
fn ramp(share: f64) -> DVec3 {
    const COLORS: [DVec3; 4] = [
        DVec3::new(0.16, 0.42, 0.80),
        DVec3::new(0.30, 0.75, 0.60),
        DVec3::new(0.98, 0.85, 0.30),
        DVec3::new(0.90, 0.25, 0.15),
    ];
    let place = share.clamp(0.0, 1.0) * (COLORS.len() - 1) as f64;
    let first = (place as usize).min(COLORS.len() - 2);
    COLORS[first].lerp(COLORS[first + 1], place - first as f64)
}
