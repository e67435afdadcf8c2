//! Visible subsets, and the meshes of the output.
//!
//! A subset is a body of the geometry and the numbers of its visible triangles; equal subsets
//! have one number however many instances show them, so memory follows distinct subsets.

use std::collections::{BTreeMap, HashMap};
use std::rc::Rc;

use serde_json::{Map, Value, json};
use sightline_geometry::{Moment, PrimitiveSet};

use super::Warnings;
use super::frozen::Frozen;
use super::output::Output;
use super::source::{Elements, FLOAT, Shape, Source, index};
use crate::Scene;

/// A body, and which of its triangles are visible.
#[derive(Clone, PartialEq, Eq, Hash)]
struct Subset {
    body: u32,
    /// Ascending numbers in the body; `None` for all.
    triangles: Option<Rc<[u32]>>,
}

/// Visible primitives of a glTF mesh: (index into its `primitives`, number of the subset).
pub(super) type Shown = Vec<(u32, u32)>;

/// What is visible of each node, by instance of EXT_mesh_gpu_instancing (`None` without).
pub(super) struct Placed {
    subsets: Vec<Subset>,
    pub(super) nodes: BTreeMap<u32, BTreeMap<Option<u32>, Shown>>,
    /// The same for what an animation or a skin places.
    pub(super) posed: BTreeMap<u32, BTreeMap<Option<u32>, Vec<Part>>>,
}

/// The visible triangles of one instance of the geometry.
pub(super) struct Part {
    /// Index into the `primitives` of the glTF mesh.
    pub(super) primitive: u32,
    /// Index into the instances of the geometry.
    pub(super) instance: usize,
    /// Ascending numbers in its body.
    pub(super) triangles: Vec<u32>,
}

/// Sorts a set by node, instance and primitive. The set must be one of the scene.
pub(super) fn placed(scene: &Scene, set: &PrimitiveSet) -> Placed {
    let mut placed = Placed { subsets: vec![], nodes: BTreeMap::new(), posed: BTreeMap::new() };
    let mut numbers: HashMap<Subset, u32> = HashMap::new();
    let geometry = &scene.geometry;
    let mut runs = set.runs().iter().copied().peekable();
    for (number, (instance, source)) in geometry.instances.iter().zip(&scene.instances).enumerate()
    {
        let first = instance.first_primitive.0;
        let count = geometry.meshes[instance.mesh.index()].triangles.len() as u32;
        let mut visible = vec![];
        while let Some(run) = runs.peek().filter(|r| r.first < first + count) {
            let (from, to) = (run.first.max(first), run.end.min(first + count));
            visible.push(from - first..to - first);
            if run.end > first + count {
                break;
            }
            runs.next();
        }
        if visible.is_empty() {
            continue;
        }
        if source.posed {
            let triangles = visible.into_iter().flatten().collect();
            let part = Part { primitive: source.primitive, instance: number, triangles };
            let node = placed.posed.entry(source.node).or_default();
            node.entry(source.gpu_instance).or_default().push(part);
            continue;
        }
        let all = visible.len() == 1 && visible[0].len() == count as usize;
        let triangles = (!all).then(|| visible.into_iter().flatten().collect());
        let subset = Subset { body: instance.mesh.0, triangles };
        let number = *numbers.entry(subset).or_insert_with_key(|subset| {
            placed.subsets.push(subset.clone());
            placed.subsets.len() as u32 - 1
        });
        let node = placed.nodes.entry(source.node).or_default();
        node.entry(source.gpu_instance).or_default().push((source.primitive, number));
    }
    for shown in placed.nodes.values_mut().flat_map(BTreeMap::values_mut) {
        shown.sort_unstable();
    }
    for parts in placed.posed.values_mut().flat_map(BTreeMap::values_mut) {
        parts.sort_unstable_by_key(|p| p.primitive);
    }
    placed
}

/// The meshes of the output.
pub(super) struct Meshes<'a> {
    source: &'a Source<'a>,
    scene: &'a Scene,
    /// When what moves is frozen.
    moment: Moment,
    /// Numbers by glTF mesh, visible primitives and the bits of a node's own weights.
    numbers: HashMap<(usize, Shown, Vec<u64>), usize>,
    primitives: HashMap<(usize, u32, u32, Vec<u64>), Value>,
    /// Their JSON; `material` is still the number in the source.
    pub(super) json: Vec<Value>,
    /// Triangles in the file.
    pub(super) triangles: u64,
}

impl<'a> Meshes<'a> {
    pub(super) fn new(source: &'a Source<'a>, scene: &'a Scene, moment: Moment) -> Self {
        Self {
            source,
            scene,
            moment,
            numbers: HashMap::new(),
            primitives: HashMap::new(),
            json: vec![],
            triangles: 0,
        }
    }

    /// The number of the mesh that shows the primitives of a node's mesh; `None` when the
    /// source is not what the scene was read from.
    pub(super) fn number(
        &mut self,
        placed: &Placed,
        node: &Value,
        shown: &Shown,
        output: &mut Output,
        warnings: &mut Warnings,
    ) -> Option<usize> {
        let mesh = index(&node["mesh"])?;
        let source = self.source;
        let json = source.entry("meshes", mesh);
        let weights = weights(&node["weights"]).or_else(|| weights(&json["weights"]));
        let weights = weights.unwrap_or_default();
        let bits: Vec<u64> = weights.iter().map(|w| w.to_bits()).collect();
        let key = (mesh, shown.clone(), bits.clone());
        if let Some(&number) = self.numbers.get(&key) {
            return Some(number);
        }
        let mut primitives = Vec::with_capacity(shown.len());
        for &(primitive, subset) in shown {
            let key = (mesh, primitive, subset, bits.clone());
            if !self.primitives.contains_key(&key) {
                let job = Job {
                    source,
                    json: &json["primitives"][primitive as usize],
                    weights: &weights,
                };
                let subset = &placed.subsets[subset as usize];
                let place = format!("mesh {mesh}, primitive {primitive}");
                let triangles = self.triangle_numbers(subset);
                self.triangles += triangles.len() as u64;
                let value = job.rebuild(&triangles, None, &place, output, warnings)?;
                self.primitives.insert(key.clone(), value);
            }
            primitives.push(self.primitives[&key].clone());
        }
        let number = self.push(mesh, primitives, warnings);
        self.numbers.insert(key, number);
        Some(number)
    }

    /// Gives a root its mesh and its place: the visible part of a mesh that an animation or a skin
    /// places, frozen. `None` as for [`Meshes::number`].
    pub(super) fn freeze(
        &mut self,
        node: &Value,
        parts: &[Part],
        root: &mut Map<String, Value>,
        output: &mut Output,
        warnings: &mut Warnings,
    ) -> Option<()> {
        let mesh = index(&node["mesh"])?;
        let source = self.source;
        let json = source.entry("meshes", mesh);
        let mut primitives = Vec::with_capacity(parts.len());
        let mut place = None;
        for part in parts {
            let job =
                Job { source, json: &json["primitives"][part.primitive as usize], weights: &[] };
            let mut frozen = Frozen::new(self.scene, part, self.moment, &mut place);
            frozen.bends |= !node["skin"].is_null();
            let mut triangles = frozen.of_file();
            triangles.sort_unstable();
            self.triangles += triangles.len() as u64;
            let named = format!("mesh {mesh}, primitive {}", part.primitive);
            primitives.push(job.rebuild(&triangles, Some(&frozen), &named, output, warnings)?);
        }
        let place = place?;
        root.insert("mesh".into(), self.push(mesh, primitives, warnings).into());
        root.insert("translation".into(), json!(place.translation.to_array()));
        if place.mirrored {
            root.insert("scale".into(), json!([-1.0, 1.0, 1.0]));
        }
        Some(())
    }

    /// Adds a mesh named as in the source.
    fn push(&mut self, mesh: usize, primitives: Vec<Value>, warnings: &mut Warnings) -> usize {
        let json = self.source.entry("meshes", mesh);
        let mut out = json!({ "primitives": primitives });
        for key in ["name", "extras"] {
            if let Some(value) = json.get(key) {
                out[key] = value.clone();
            }
        }
        if json.get("extensions").is_some() {
            warnings.add("extensions of a mesh are left out", format!("mesh {mesh}"));
        }
        self.json.push(out);
        self.json.len() - 1
    }

    /// Ascending numbers of a subset's triangles in the glTF primitive.
    fn triangle_numbers(&self, subset: &Subset) -> Vec<u32> {
        let of_file = &*self.scene.meshes[subset.body as usize].triangles;
        let mut numbers = match &subset.triangles {
            None => of_file.to_vec(),
            Some(chosen) => chosen.iter().map(|&t| of_file[t as usize]).collect(),
        };
        numbers.sort_unstable();
        numbers
    }
}

fn weights(value: &Value) -> Option<Vec<f64>> {
    let list = value.as_array()?;
    // The reader takes weights as `f32`.
    Some(list.iter().map(|w| f64::from(w.as_f64().unwrap_or(0.0) as f32)).collect())
}

/// One primitive that is to be rebuilt.
struct Job<'a> {
    source: &'a Source<'a>,
    json: &'a Value,
    weights: &'a [f64],
}

impl<'a> Job<'a> {
    fn rebuild(
        &self,
        triangles: &[u32],
        frozen: Option<&Frozen>,
        place: &str,
        output: &mut Output,
        warnings: &mut Warnings,
    ) -> Option<Value> {
        let (mut attributes, corners) = self.read(place, warnings)?;
        let position = attributes.remove("POSITION")?;
        let position = match frozen {
            None => self.displaced(position)?,
            Some(frozen) => {
                frozen.directions(&mut attributes, place, warnings)?;
                frozen.positions(position.count, &corners)?
            }
        };
        if self.json["targets"].as_array().is_some_and(|t| !t.is_empty()) {
            warnings.add("morph targets are left out", place);
        }
        // Vertices in the order of their first use.
        let mut new_number = vec![u32::MAX; position.count];
        let (mut used, mut indices) = (vec![], Vec::with_capacity(3 * triangles.len()));
        for &t in triangles {
            for v in *corners.get(t as usize)? {
                let number = new_number.get_mut(v as usize)?;
                if *number == u32::MAX {
                    *number = used.len() as u32;
                    used.push(v);
                }
                indices.push(*number);
            }
        }
        let mut out = json!({ "indices": output.indices(&indices, used.len()) });
        out["attributes"]["POSITION"] = output.vertices("POSITION", &position, &used).into();
        let largest = used.iter().copied().max().unwrap_or(0) as usize;
        for (name, elements) in &attributes {
            if elements.count <= largest {
                warnings.add(
                    "a vertex attribute is too short and left out",
                    format!("{place}, {name}"),
                );
                continue;
            }
            out["attributes"][name] = output.vertices(name, elements, &used).into();
        }
        for key in ["material", "extras"] {
            if let Some(value) = self.json.get(key) {
                out[key] = value.clone();
            }
        }
        for (name, _) in self.json["extensions"].as_object().into_iter().flatten() {
            if name != "KHR_draco_mesh_compression" {
                warnings.add("extensions of a primitive are left out", format!("{place}, {name}"));
            }
        }
        Some(out)
    }

    /// Attributes by name, and the corners of every triangle.
    fn read(&self, place: &str, warnings: &mut Warnings) -> Option<Read<'a>> {
        let (source, json) = (self.source, self.json);
        let draco = &json["extensions"]["KHR_draco_mesh_compression"];
        // As the reader does: data of its own goes before compressed data.
        let own = source.has_view(&json["attributes"]["POSITION"])
            && (json["indices"].is_null() || source.has_view(&json["indices"]));
        let skinning = |name: &str| name.starts_with("JOINTS_") || name.starts_with("WEIGHTS_");
        if !draco.is_null() && !own {
            let mut decoded = source.draco(draco, &json["attributes"])?;
            decoded.attributes.retain(|name, _| !skinning(name));
            return Some((decoded.attributes, decoded.triangles));
        }
        let mut attributes = BTreeMap::new();
        for (name, accessor) in json["attributes"].as_object()? {
            if skinning(name) {
                warnings
                    .add("joints and weights of skins are left out", format!("{place}, {name}"));
                continue;
            }
            match index(accessor).and_then(|a| source.elements(a)) {
                Some(elements) => drop(attributes.insert(name.clone(), elements)),
                None => warnings.add(
                    "a vertex attribute cannot be read and is left out",
                    format!("{place}, {name}"),
                ),
            }
        }
        let vertices = attributes.get("POSITION")?.count;
        let list = source.indices(&json["indices"], vertices)?;
        Some((attributes, triangles(json["mode"].as_u64().unwrap_or(4), &list)))
    }

    /// Positions with the morph targets' weights at rest, as the reader applies them.
    fn displaced(&self, position: Elements<'a>) -> Option<Elements<'a>> {
        let targets = self.json["targets"].as_array().map_or(&[][..], Vec::as_slice);
        let moving: Vec<(&Value, f64)> = targets
            .iter()
            .zip(self.weights)
            .filter(|(t, w)| **w != 0.0 && !t["POSITION"].is_null())
            .map(|(t, w)| (&t["POSITION"], *w))
            .collect();
        if moving.is_empty() {
            return Some(position);
        }
        let values = |e: &Elements| -> Vec<f32> {
            (0..e.count).flat_map(|i| e.shape.values(e.get(i))).map(|v| v as f32).collect()
        };
        let mut moved = values(&position);
        for (target, weight) in moving {
            let offsets = values(&self.source.elements(index(target)?)?);
            for (p, d) in moved.iter_mut().zip(offsets) {
                *p = (f64::from(*p) + weight * f64::from(d)) as f32;
            }
        }
        Elements::of_floats(
            Shape { component: FLOAT, kind: "VEC3".into(), normalized: false },
            &moved,
        )
    }
}

type Read<'a> = (BTreeMap<String, Elements<'a>>, Vec<[u32; 3]>);

/// Corners of the triangles of a list, strip (5) or fan (6), numbered as the reader does.
fn triangles(mode: u64, list: &[u32]) -> Vec<[u32; 3]> {
    let strips = list.len().saturating_sub(2);
    match mode {
        5 => (0..strips).map(|i| [list[i], list[i + 1 + i % 2], list[i + 2 - i % 2]]).collect(),
        6 => (0..strips).map(|i| [list[i + 1], list[i + 2], list[0]]).collect(),
        _ => list.as_chunks::<3>().0.to_vec(),
    }
}
