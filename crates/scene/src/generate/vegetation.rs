//! Trees: a closed trunk with branches, and a crown of blobs or of single leaves.

use glam::{DQuat, DVec3};

use super::material::Material;
use super::random::Random;
use super::solid::Solid;

/// A street tree: a trunk and `blobs` closed leafy bodies of 80 triangles. The crown starts
/// above 3 m and stays within 2 m of the trunk.
pub(super) fn blob_tree(random: &mut Random, blobs: usize) -> Solid {
    let mut solid = Solid::new();
    solid.frustum(Material::Bark, DVec3::ZERO, (-0.2, 0.16), (4.4, 0.11), 6);
    for k in 0..blobs {
        let (s, c) = super::random::sin_cos(random.angle());
        let off = if k == 0 { 0.0 } else { random.between(0.3, 0.8) };
        let height = random.between(4.3, 6.2);
        // The first one sits on the trunk.
        let height = if k == 0 { 0.3 * height + 3.1 } else { height };
        let center = DVec3::new(off * s, height, off * c);
        let size = random.between(0.9, 1.15);
        let material = if random.chance(0.5) { Material::Leaf } else { Material::DarkLeaf };
        solid.blob(material, center, |_| size * random.between(0.78, 1.04));
    }
    solid
}

/// A tree of `leaves` small diamonds of two triangles each on a trunk with branches, about
/// `height` metres high; crown within 0.35 `height` of the trunk and above 0.25 `height`.
pub(super) fn leafy_tree(random: &mut Random, height: f64, leaves: usize) -> Solid {
    let mut solid = Solid::new();
    let trunk = 0.55 * height;
    solid.frustum(Material::Bark, DVec3::ZERO, (-0.3, 0.035 * height), (trunk, 0.012 * height), 8);
    let branches = (leaves / 120).clamp(4, 24);
    // Tips of branches carry the leaves in clusters.
    let mut tips = vec![];
    for k in 0..branches {
        let t = (k as f64 + 0.5) / branches as f64;
        let (s, c) = super::random::sin_cos(2.399_963 * k as f64 + random.between(0.0, 0.6));
        let from = DVec3::Y * (height * (0.28 + 0.26 * t));
        let reach = height * random.between(0.14, 0.24) * (1.15 - 0.55 * t);
        let tip = from + DVec3::new(reach * s, height * random.between(0.1, 0.3), reach * c);
        let along = (tip - from).normalize();
        let side = along.cross(DVec3::Y).normalize();
        let up = side.cross(along);
        let w = 0.006 * height;
        solid.beam(Material::Bark, from, tip, w * up, w * side);
        tips.push(tip);
    }
    tips.push(DVec3::Y * (0.8 * height));
    let materials = [Material::Leaf, Material::DarkLeaf, Material::PaleLeaf];
    for k in 0..leaves {
        let cluster = k % tips.len();
        // Denser towards the middle of the cluster.
        let radius = 0.17 * height * random.unit().sqrt();
        let center = tips[cluster] + radius * direction(random);
        let size = random.between(0.06, 0.13) * (height / 8.0).max(0.7);
        let turn = DQuat::from_rotation_arc(DVec3::Z, direction(random));
        let corner = |x: f64, y: f64| center + turn * DVec3::new(size * x, size * y, 0.0);
        let corners = [corner(0.0, -1.4), corner(0.7, 0.0), corner(0.0, 1.4), corner(-0.7, 0.0)];
        solid.quad(materials[(cluster + k / 7 % 2) % 3], corners);
    }
    solid
}

/// A uniform direction.
pub(super) fn direction(random: &mut Random) -> DVec3 {
    let y = random.between(-1.0, 1.0);
    let (s, c) = super::random::sin_cos(random.angle());
    let r = (1.0 - y * y).sqrt();
    DVec3::new(r * s, y, r * c)
}
