//! The nodes of the output: those with something visible, cameras or lights, and their parents.
//!
//! Nodes keep their order, names, transforms and extras. Nodes that the export adds (children for
//! instances, roots for meshes that an animation or a skin places) come behind them.

use std::collections::{BTreeMap, HashMap};

use serde_json::{Map, Value, json};

use super::Warnings;
use super::output::Output;
use super::source::{Elements, Source, index};
use super::subset::{Meshes, Placed};

/// Node extensions that refer to nothing which is renumbered.
const NODE_EXTENSIONS: [&str; 4] = [
    "KHR_lights_punctual",
    "KHR_node_visibility",
    "KHR_node_selectability",
    "KHR_node_hoverability",
];

/// The nodes of the output.
pub(super) struct Nodes {
    pub(super) json: Vec<Value>,
    pub(super) roots: Vec<usize>,
}

/// Builds the nodes and the meshes that they show; `None` when the source is not what the
/// scene was read from.
pub(super) fn build(
    source: &Source,
    placed: &Placed,
    meshes: &mut Meshes,
    output: &mut Output,
    warnings: &mut Warnings,
) -> Option<Nodes> {
    let empty = vec![];
    let all = source.json["nodes"].as_array().unwrap_or(&empty);
    let (roots, order) = walk(source, all)?;
    let mut kept = vec![false; all.len()];
    for &n in order.iter().rev() {
        let node = &all[n];
        let shows = placed.nodes.contains_key(&(n as u32));
        let light = !node["extensions"]["KHR_lights_punctual"].is_null();
        let below = children(node).any(|c| kept[c]);
        kept[n] = shows || below || light || !node["camera"].is_null();
    }
    let mut numbers = HashMap::new();
    for n in (0..all.len()).filter(|&n| kept[n]) {
        numbers.insert(n, numbers.len());
    }
    let mut out = Nodes { json: vec![], roots: vec![] };
    let mut added = vec![];
    let mut free = numbers.len();
    let mut add = |json: Value| {
        added.push(json);
        free += 1;
        free - 1
    };
    out.roots.extend(roots.iter().filter_map(|r| numbers.get(r)));
    for (n, node) in all.iter().enumerate() {
        let shown = placed.nodes.get(&(n as u32));
        for (instance, frozen) in placed.posed.get(&(n as u32)).into_iter().flatten() {
            let mut json = Map::new();
            copy(node, &["name", "extras"], &mut json);
            if let Some(instance) = instance {
                let name = node["name"].as_str().unwrap_or("instance");
                json.insert("name".into(), format!("{name}#{instance}").into());
            }
            meshes.freeze(node, frozen, &mut json, output, warnings)?;
            out.roots.push(add(json.into()));
        }
        if !kept[n] {
            continue;
        }
        let mut json = Map::new();
        copy(
            node,
            &["name", "extras", "matrix", "translation", "rotation", "scale", "camera"],
            &mut json,
        );
        keep_extensions(n, node, &mut json, warnings);
        let below = children(node).filter_map(|c| numbers.get(&c).copied()).collect::<Vec<_>>();
        if !below.is_empty() {
            json.insert("children".into(), json!(below));
        }
        if let Some(shown) = shown {
            show(source, placed, (n, shown), meshes, output, warnings, &mut json, &mut add)?;
        }
        out.json.push(json.into());
    }
    out.json.append(&mut added);
    Some(out)
}

fn copy(from: &Value, keys: &[&str], to: &mut Map<String, Value>) {
    for key in keys {
        if let Some(value) = from.get(key) {
            to.insert((*key).into(), value.clone());
        }
    }
}

fn children(node: &Value) -> impl Iterator<Item = usize> + '_ {
    node["children"].as_array().into_iter().flatten().filter_map(index)
}

/// Roots of the default scene, and every node below them, parents first.
fn walk(source: &Source, all: &[Value]) -> Option<(Vec<usize>, Vec<usize>)> {
    let scenes = &source.json["scenes"];
    let scene = source.json["scene"].as_u64().unwrap_or(0) as usize;
    let roots: Vec<usize> = match scenes.get(scene) {
        Some(scene) => scene["nodes"].as_array().into_iter().flatten().filter_map(index).collect(),
        None => {
            let mut orphan = vec![true; all.len()];
            for child in all.iter().flat_map(children) {
                *orphan.get_mut(child)? = false;
            }
            (0..all.len()).filter(|&n| orphan[n]).collect()
        }
    };
    let mut order = roots.clone();
    let mut next = 0;
    while next < order.len() {
        order.extend(children(all.get(order[next])?));
        // The reader refuses nodes with two parents, so that this ends.
        if order.len() > all.len() {
            return None;
        }
        next += 1;
    }
    Some((roots, order))
}

fn keep_extensions(n: usize, node: &Value, json: &mut Map<String, Value>, warnings: &mut Warnings) {
    let mut kept = Map::new();
    for (name, value) in node["extensions"].as_object().into_iter().flatten() {
        if NODE_EXTENSIONS.contains(&name.as_str()) {
            kept.insert(name.clone(), value.clone());
        } else if name != "EXT_mesh_gpu_instancing" {
            warnings.add("an extension of a node is left out", format!("node {n}, {name}"));
        }
    }
    if !kept.is_empty() {
        json.insert("extensions".into(), kept.into());
    }
}

/// Gives a node its mesh, or children for its instances.
#[allow(clippy::too_many_arguments)]
fn show(
    source: &Source,
    placed: &Placed,
    (n, shown): (usize, &BTreeMap<Option<u32>, super::subset::Shown>),
    meshes: &mut Meshes,
    output: &mut Output,
    warnings: &mut Warnings,
    json: &mut Map<String, Value>,
    add: &mut impl FnMut(Value) -> usize,
) -> Option<()> {
    let node = source.entry("nodes", n);
    // Instances by the mesh that they show, in the order of their first.
    let mut groups: Vec<(usize, Vec<u32>)> = vec![];
    let mut group_of: HashMap<usize, usize> = HashMap::new();
    for (instance, primitives) in shown {
        let mesh = meshes.number(placed, node, primitives, output, warnings)?;
        let Some(instance) = instance else {
            json.insert("mesh".into(), mesh.into());
            return Some(());
        };
        let group = *group_of.entry(mesh).or_insert_with(|| {
            groups.push((mesh, vec![]));
            groups.len() - 1
        });
        groups[group].1.push(*instance);
    }
    let attributes = instance_attributes(source, n, node, warnings);
    if let [(mesh, instances)] = &groups[..] {
        json.insert("mesh".into(), (*mesh).into());
        let extensions = json.entry("extensions").or_insert_with(|| json!({}));
        extensions["EXT_mesh_gpu_instancing"] = instanced(&attributes, instances, output);
        return Some(());
    }
    let name = node["name"].as_str().unwrap_or("instance");
    let mut below = vec![];
    for (mesh, instances) in groups {
        let mut child = json!({ "name": format!("{name}#{}", instances[0]), "mesh": mesh });
        if let [instance] = instances[..] {
            place(&attributes, instance as usize, &mut child);
        } else {
            child["extensions"]["EXT_mesh_gpu_instancing"] =
                instanced(&attributes, &instances, output);
        }
        below.push(Value::from(add(child)));
    }
    let list = json.entry("children").or_insert_with(|| json!([]));
    list.as_array_mut()?.append(&mut below);
    Some(())
}

fn instance_attributes<'a>(
    source: &Source<'a>,
    n: usize,
    node: &Value,
    warnings: &mut Warnings,
) -> BTreeMap<String, Elements<'a>> {
    let mut out = BTreeMap::new();
    let attributes = &node["extensions"]["EXT_mesh_gpu_instancing"]["attributes"];
    for (name, accessor) in attributes.as_object().into_iter().flatten() {
        match index(accessor).and_then(|a| source.elements(a)) {
            Some(elements) => drop(out.insert(name.clone(), elements)),
            None => {
                let place = format!("node {n}, {name}");
                warnings.add("an instance attribute cannot be read and is left out", place);
            }
        }
    }
    out
}

/// The extension's object for some of the instances.
fn instanced(
    attributes: &BTreeMap<String, Elements>,
    instances: &[u32],
    output: &mut Output,
) -> Value {
    let mut json = Map::new();
    for (name, elements) in attributes {
        if instances.iter().all(|&i| (i as usize) < elements.count) {
            json.insert(name.clone(), output.instances(elements, instances).into());
        }
    }
    json!({ "attributes": json })
}

/// The transform of one instance as that of a node.
fn place(attributes: &BTreeMap<String, Elements>, instance: usize, node: &mut Value) {
    for (name, key) in
        [("TRANSLATION", "translation"), ("ROTATION", "rotation"), ("SCALE", "scale")]
    {
        let Some(elements) = attributes.get(name).filter(|e| instance < e.count) else { continue };
        let mut values = elements.shape.values(elements.get(instance));
        let length = values.iter().map(|v| v * v).sum::<f64>().sqrt();
        // Rotations that are of length 1 but for rounding stay as they are, so that the
        // reader composes the same transform; the validator allows this much.
        if key == "rotation" && (length - 1.0).abs() > 1e-4 {
            values.iter_mut().for_each(|v| *v /= length);
        }
        node[key] = json!(values);
    }
}
