//! Intel Embree 3, behind the feature `embree`.
//!
//! Scenes are built with spatial splits (`HIGH` quality). Robust traversal is left off, which makes
//! rays faster; a ray within rounding of an edge may miss.

use std::sync::Arc;

use embree3::{
    BufferUsage, BuildQuality, Device, Format, Geometry, GeometryKind, Hit16, IntersectContext,
    Ray, Ray16, RayHit, RayHit16, Scene, ValidMask, ValidMaskN,
};
use glam::DVec3;
use sightline_geometry::{InstancedGeometry, Mesh};

use super::{FLAT_MAX, LocalHit, LocalRay, MISS, Tracer};

/// A committed scene.
pub struct EmbreeScene {
    scene: Scene<'static>,
    origin: DVec3,
    /// First primitive an instance, or 0 alone for a flat scene.
    first_primitives: Vec<u32>,
    is_flat: bool,
    /// Instances refer to these.
    _meshes: Vec<Scene<'static>>,
}

fn text(error: embree3::Error) -> String {
    format!("Embree: {error:?}")
}

fn body(
    device: &Device,
    vertices: &[[f32; 3]],
    triangles: &[[u32; 3]],
) -> Result<Geometry<'static>, String> {
    let mut builder = device.create_geometry(GeometryKind::TRIANGLE).map_err(text)?;
    builder
        .set_new_buffer::<[f32; 3]>(BufferUsage::VERTEX, 0, Format::FLOAT3, 12, vertices.len())
        .map_err(text)?
        .copy_from_slice(vertices);
    builder
        .set_new_buffer::<[u32; 3]>(BufferUsage::INDEX, 0, Format::UINT3, 12, triangles.len())
        .map_err(text)?
        .copy_from_slice(triangles);
    Ok(builder.commit())
}

fn committed(
    device: &Device,
    geometries: impl IntoIterator<Item = Geometry<'static>>,
) -> Result<Scene<'static>, String> {
    let mut scene = device.create_scene().map_err(text)?;
    scene.set_build_quality(BuildQuality::HIGH);
    for geometry in geometries {
        scene.attach_geometry(&geometry);
    }
    scene.commit();
    Ok(scene)
}

impl EmbreeScene {
    /// Builds the scene, for rays that start near `origin`.
    ///
    /// # Errors
    /// When Embree refuses.
    pub fn new(geometry: &InstancedGeometry, origin: DVec3) -> Result<Self, String> {
        let device = Device::new().map_err(text)?;
        let is_flat = geometry.primitive_count() <= FLAT_MAX;
        let mesh_of = |mesh: &Mesh| body(&device, &mesh.positions, &mesh.triangles);
        if is_flat {
            let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
            for instance in &geometry.instances {
                let mesh = &geometry.meshes[instance.mesh.index()];
                let first = vertices.len() as u32;
                vertices.extend(mesh.positions.iter().map(|p| {
                    let p = DVec3::from_array(p.map(f64::from));
                    (instance.world_from_mesh.transform_point3(p) - origin).as_vec3().to_array()
                }));
                triangles.extend(mesh.triangles.iter().map(|t| t.map(|v| first + v)));
            }
            let scene = committed(&device, [body(&device, &vertices, &triangles)?])?;
            return Ok(Self { scene, origin, first_primitives: vec![0], is_flat, _meshes: vec![] });
        }
        let meshes = geometry
            .meshes
            .iter()
            .map(|mesh| committed(&device, [mesh_of(mesh)?]))
            .collect::<Result<Vec<_>, String>>()?;
        let mut instances = Vec::with_capacity(geometry.instances.len());
        for instance in &geometry.instances {
            let mut builder = device.create_geometry(GeometryKind::INSTANCE).map_err(text)?;
            builder.set_instanced_scene(&meshes[instance.mesh.index()]);
            let m = instance.world_from_mesh;
            let columns =
                [m.matrix3.x_axis, m.matrix3.y_axis, m.matrix3.z_axis, m.translation - origin];
            let mut matrix = [0f32; 16];
            for (k, column) in columns.iter().enumerate() {
                matrix[4 * k..4 * k + 3].copy_from_slice(&column.as_vec3().to_array());
            }
            matrix[15] = 1.0;
            builder.set_transform(0, &matrix);
            instances.push(builder.commit());
        }
        let scene = committed(&device, instances)?;
        let first_primitives = geometry.instances.iter().map(|i| i.first_primitive.0).collect();
        Ok(Self { scene, origin, first_primitives, is_flat, _meshes: meshes })
    }

    #[inline]
    fn hit(&self, instance: u32, triangle: u32, distance: f32) -> LocalHit {
        if triangle == embree3::INVALID_ID {
            return LocalHit::MISS;
        }
        let instance = if self.is_flat { 0 } else { instance as usize };
        LocalHit { primitive: self.first_primitives[instance] + triangle, distance }
    }
}

/// A way of tracing an Embree scene.
pub struct Embree {
    scene: Arc<EmbreeScene>,
    packets: bool,
}

impl Embree {
    /// One ray at a time.
    #[must_use]
    pub fn single(scene: Arc<EmbreeScene>) -> Self {
        Self { scene, packets: false }
    }

    /// Sixteen rays at a time, taken in the order they come.
    #[must_use]
    pub fn packets(scene: Arc<EmbreeScene>) -> Self {
        Self { scene, packets: true }
    }

    fn one(&self, ray: &LocalRay) -> LocalHit {
        let ray = Ray::segment(ray.origin.to_array(), ray.direction.to_array(), 0.0, f32::INFINITY);
        let mut hit = RayHit::from(ray);
        self.scene.scene.intersect(&mut IntersectContext::incoherent(), &mut hit);
        let triangle = if hit.hit.is_valid() { hit.hit.primID } else { MISS };
        self.scene.hit(hit.hit.instID[0], triangle, hit.ray.tfar)
    }

    fn sixteen(&self, rays: &[LocalRay], hits: &mut Vec<LocalHit>) {
        let at = |k: usize| &rays[k.min(rays.len() - 1)];
        let ray = Ray16::new(
            std::array::from_fn(|k| at(k).origin.to_array()),
            std::array::from_fn(|k| at(k).direction.to_array()),
        );
        let mut packet = RayHit16 { ray, hit: Hit16::new() };
        let valid = ValidMaskN::new(std::array::from_fn(|k| {
            if k < rays.len() { ValidMask::Valid } else { ValidMask::Invalid }
        }));
        self.scene.scene.intersect16(&mut IntersectContext::coherent(), &mut packet, &valid);
        hits.extend((0..rays.len()).map(|k| {
            let triangle = if packet.hit.geomID[k] == embree3::INVALID_ID {
                MISS
            } else {
                packet.hit.primID[k]
            };
            self.scene.hit(packet.hit.instID[0][k], triangle, packet.ray.tfar[k])
        }));
    }
}

impl Tracer for Embree {
    fn name(&self) -> &'static str {
        if self.packets { "Embree 3, packets of 16" } else { "Embree 3, single rays" }
    }

    fn origin(&self) -> DVec3 {
        self.scene.origin
    }

    fn closest(&self, rays: &[LocalRay], hits: &mut Vec<LocalHit>) {
        hits.clear();
        if self.packets {
            for rays in rays.chunks(16) {
                self.sixteen(rays, hits);
            }
        } else {
            hits.extend(rays.iter().map(|ray| self.one(ray)));
        }
    }
}
