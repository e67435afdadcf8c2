//! Animations: from channels to what each node does over time.
//!
//! Source: Khronos, "glTF 2.0 Specification", section 3.11; the extension KHR_animation_pointer, for
//! pointers to transforms and weights of nodes.
//!
//! Promise: what is followed is followed as the file says, or the file is refused with the animation,
//! channel and sampler that cannot be; a wrong motion would go unnoticed. Channels that move nothing
//! that is read here (a camera's lens, a colour) are left out and counted.
//!
//! Modules: `sampler` evaluates one property; `rig` the nodes; `skin` and `deform` vertices; `bend`
//! bounds how far from straight a thing moves; `key_frames` chooses the key frames.

pub mod bend;
pub mod deform;
pub mod key_frames;
pub mod rig;
pub mod sampler;
pub mod skin;

use std::{
    collections::{BTreeMap, HashMap},
    sync::Arc,
};

use serde::Deserialize;
use serde_json::{Map, Value};

use super::{
    accessors::{Accessors, KEY_ROTATIONS, KEY_TIMES, KEY_VECTORS, KEY_WEIGHTS},
    document::{Document, part, shorten},
};
use crate::{AnimationChoice, Cause, IgnoredChannels, SceneError};
use sampler::{Interpolation, Sampler};

/// What a channel can move.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Property {
    Translation,
    Rotation,
    Scale,
    Weights,
}

impl Property {
    fn of(name: &str) -> Option<Self> {
        [Self::Translation, Self::Rotation, Self::Scale, Self::Weights]
            .into_iter()
            .find(|p| p.name() == name)
    }

    /// Its name in the file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Translation => "translation",
            Self::Rotation => "rotation",
            Self::Scale => "scale",
            Self::Weights => "weights",
        }
    }
}

/// What moves one property of a node.
#[derive(Clone, Debug)]
struct Track {
    sampler: Sampler,
    /// Animation and channel.
    place: String,
}

/// What moves a node.
#[derive(Clone, Debug, Default)]
pub struct NodeTracks {
    tracks: [Option<Track>; 4],
}

impl NodeTracks {
    /// What moves a property.
    pub fn get(&self, property: Property) -> Option<&Sampler> {
        self.tracks[property as usize].as_ref().map(|t| &t.sampler)
    }

    /// What moves its transform.
    pub fn transform(&self) -> impl Iterator<Item = &Sampler> {
        [Property::Translation, Property::Rotation, Property::Scale]
            .into_iter()
            .filter_map(|p| self.get(p))
    }

    /// True when its transform is the animation's.
    pub fn poses(&self) -> bool {
        self.transform().next().is_some()
    }

    /// True when its transform changes over time.
    pub fn moves(&self) -> bool {
        self.transform().any(|s| !s.is_constant())
    }
}

/// What moves the scene.
#[derive(Debug, Default)]
pub struct Animations {
    /// By index of the node. Not all of them need be in the scene.
    pub nodes: BTreeMap<u32, NodeTracks>,
    /// Names of the animations in the file.
    pub names: Vec<String>,
    /// Names of those that were taken.
    pub taken: Vec<String>,
    /// The time of the last key, seconds.
    pub duration: f64,
    /// Channels that are not followed, by reason.
    pub ignored: BTreeMap<&'static str, IgnoredChannels>,
}

impl Animations {
    /// Notes a channel that is not followed.
    pub fn ignore(&mut self, reason: &'static str, place: impl FnOnce() -> String) {
        let new = || IgnoredChannels { reason: reason.into(), count: 0, first: place() };
        self.ignored.entry(reason).or_insert_with(new).count += 1;
    }

    /// Notes channels of nodes that are not in the scene.
    pub fn ignore_nodes_outside(&mut self, is_in_scene: impl Fn(u32) -> bool) {
        let outside = self.nodes.iter().filter(|(node, _)| !is_in_scene(**node));
        let places: Vec<(u32, String)> = outside
            .flat_map(|(&node, t)| t.tracks.iter().flatten().map(move |t| (node, t.place.clone())))
            .collect();
        for (node, place) in places {
            self.ignore("a node outside the scene", || format!("{place}: node {node}"));
        }
    }

    /// The weights of a node's morph targets at time 0, where an animation sets them.
    pub fn weights(&self, node: u32) -> Option<&Sampler> {
        self.nodes.get(&node)?.get(Property::Weights)
    }
}

#[derive(Deserialize)]
struct AnimationJson {
    #[serde(default)]
    channels: Vec<ChannelJson>,
    #[serde(default)]
    samplers: Vec<SamplerJson>,
}

#[derive(Deserialize)]
struct ChannelJson {
    sampler: u32,
    target: TargetJson,
}

#[derive(Deserialize)]
struct TargetJson {
    node: Option<u32>,
    path: String,
    #[serde(default)]
    extensions: Map<String, Value>,
}

#[derive(Deserialize)]
struct SamplerJson {
    input: u32,
    output: u32,
    interpolation: Option<String>,
}

/// Reads the animations that the options choose.
pub fn read(
    document: &Document,
    accessors: &Accessors,
    choice: &AnimationChoice,
) -> Result<Animations, SceneError> {
    let names = names(document);
    let chosen = chosen(&names, choice)?;
    let mut reader = Reader {
        document,
        accessors,
        times: HashMap::new(),
        values: HashMap::new(),
        out: Animations::default(),
    };
    for animation in chosen {
        reader.out.taken.push(names[animation].clone());
        reader
            .animation(animation, &document.animations[animation])
            .map_err(|e| e.at_animation(animation))?;
    }
    Ok(Animations { names, ..reader.out })
}

fn names(document: &Document) -> Vec<String> {
    let name = |(i, a): (usize, &Value)| match a["name"].as_str() {
        Some(name) if !name.is_empty() => shorten(name),
        _ => format!("#{i}"),
    };
    document.animations.iter().enumerate().map(name).collect()
}

fn chosen(names: &[String], choice: &AnimationChoice) -> Result<Vec<usize>, SceneError> {
    let found = match choice {
        AnimationChoice::None => return Ok(vec![]),
        AnimationChoice::First => return Ok((0..names.len().min(1)).collect()),
        AnimationChoice::All => return Ok((0..names.len()).collect()),
        AnimationChoice::Index(index) => names.get(*index as usize).map(|_| *index as usize),
        AnimationChoice::Name(name) => names.iter().position(|n| *n == shorten(name)),
    };
    let wanted = match choice {
        AnimationChoice::Name(name) => format!("`{}`", shorten(name)),
        AnimationChoice::Index(index) => index.to_string(),
        _ => String::new(),
    };
    let missing = || Cause::NoSuchAnimation { wanted, names: names.to_vec() }.into();
    found.map(|index| vec![index]).ok_or_else(missing)
}

struct Reader<'a> {
    document: &'a Document,
    accessors: &'a Accessors<'a>,
    /// By accessor: many samplers share them, and memory must not follow how many.
    times: HashMap<u32, Arc<[f64]>>,
    values: HashMap<(u32, Property), Arc<[f32]>>,
    out: Animations,
}

impl Reader<'_> {
    fn animation(&mut self, number: usize, json: &Value) -> Result<(), SceneError> {
        let json: AnimationJson = part(json)?;
        for (c, channel) in json.channels.iter().enumerate() {
            let place = || format!("animation {number}, channel {c}");
            self.channel(&json, channel, place).map_err(|e| e.at_channel(c))?;
        }
        Ok(())
    }

    fn channel(
        &mut self,
        animation: &AnimationJson,
        channel: &ChannelJson,
        place: impl Fn() -> String,
    ) -> Result<(), SceneError> {
        let target = match target(&channel.target) {
            Ok(target) => target,
            Err(reason) => {
                let what = || format!("{}: {}", place(), described(&channel.target));
                self.out.ignore(reason, what);
                return Ok(());
            }
        };
        let (node, property) = target;
        let json = Document::get(&self.document.nodes, "node", node, || "the target".into())?;
        let width = match property {
            Property::Weights => {
                let targets = json.mesh.map_or(0, |mesh| targets(self.document, mesh));
                if targets == 0 {
                    let reason = "weights of a node without morph targets";
                    self.out.ignore(reason, || format!("{}: node {node}", place()));
                    return Ok(());
                }
                targets
            }
            Property::Rotation => 4,
            Property::Translation | Property::Scale => 3,
        };
        let path = property.name();
        if property != Property::Weights && json.matrix.is_some() {
            return Err(Cause::AnimatedMatrix { node, path }.into());
        }
        let number = channel.sampler;
        let sampler = Document::get(&animation.samplers, "sampler", number, || "`sampler`".into())?;
        let sampler = self.sampler(sampler, property, width).map_err(|e| e.at_sampler(number))?;
        self.out.duration = self.out.duration.max(sampler.end());
        let slot = &mut self.out.nodes.entry(node).or_default().tracks[property as usize];
        if let Some(other) = slot {
            let (first, second) = (other.place.clone(), place());
            return Err(Cause::AnimationConflict { node, path, first, second }.into());
        }
        *slot = Some(Track { sampler, place: place() });
        Ok(())
    }

    fn sampler(
        &mut self,
        json: &SamplerJson,
        property: Property,
        width: usize,
    ) -> Result<Sampler, SceneError> {
        let interpolation = match json.interpolation.as_deref() {
            None | Some("LINEAR") => Interpolation::Linear,
            Some("STEP") => Interpolation::Step,
            Some("CUBICSPLINE") => Interpolation::CubicSpline,
            Some(_) => {
                return Err(Cause::InvalidValue { property: "`interpolation`".into() }.into());
            }
        };
        let times = match self.times.get(&json.input) {
            Some(times) => times.clone(),
            None => {
                let times = times(self.accessors, json.input)?;
                self.times.entry(json.input).or_insert(times).clone()
            }
        };
        let values = match self.values.get(&(json.output, property)) {
            Some(values) => values.clone(),
            None => {
                let values = values(self.accessors, json.output, property)?;
                self.values.entry((json.output, property)).or_insert(values).clone()
            }
        };
        let spline = interpolation == Interpolation::CubicSpline;
        let expected = times.len() * width * if spline { 3 } else { 1 };
        if values.len() != expected {
            let numbers = if property == Property::Weights { 1 } else { width };
            return Err(Cause::CountMismatch {
                accessor: json.output,
                use_as: KEY_VECTORS.name,
                count: (values.len() / numbers) as u64,
                expected: (expected / numbers) as u64,
            }
            .into());
        }
        if property == Property::Rotation {
            // In-tangents and out-tangents may be zero.
            let (first, step) = if spline { (1, 3) } else { (0, 1) };
            let zero = |at: &usize| values[4 * at..][..4] == [0.0; 4];
            if let Some(at) = (first..values.len() / 4).step_by(step).find(zero) {
                return Err(Cause::KeyValue { accessor: json.output, at: at as u64 }.into());
            }
        }
        Ok(Sampler::new(interpolation, width, times, values))
    }
}

/// Times of keys: finite, at least 0, ascending.
fn times(accessors: &Accessors, accessor: u32) -> Result<Arc<[f64]>, SceneError> {
    let times = accessors.elements(accessor, &KEY_TIMES)?.vectors::<1>()?;
    if times.is_empty() {
        return Err(Cause::NoKeys { accessor }.into());
    }
    let mut before = -1.0f32;
    for (at, &[time]) in times.iter().enumerate() {
        let ascends = if at == 0 { time >= 0.0 } else { time > before };
        if !ascends || !time.is_finite() {
            return Err(Cause::KeyTime { accessor, at: at as u64, time }.into());
        }
        before = time;
    }
    Ok(times.iter().map(|&[t]| f64::from(t)).collect())
}

/// Values of keys: finite.
fn values(
    accessors: &Accessors,
    accessor: u32,
    property: Property,
) -> Result<Arc<[f32]>, SceneError> {
    let (numbers, width) = match property {
        Property::Translation | Property::Scale => {
            let values = accessors.elements(accessor, &KEY_VECTORS)?.vectors::<3>()?;
            (values.into_flattened(), 3)
        }
        Property::Rotation => {
            let values = accessors.elements(accessor, &KEY_ROTATIONS)?.vectors::<4>()?;
            (values.into_flattened(), 4)
        }
        Property::Weights => {
            let values = accessors.elements(accessor, &KEY_WEIGHTS)?.vectors::<1>()?;
            (values.into_flattened(), 1)
        }
    };
    if let Some(at) = numbers.iter().position(|v| !v.is_finite()) {
        return Err(Cause::KeyValue { accessor, at: (at / width) as u64 }.into());
    }
    Ok(numbers.into())
}

/// Morph targets of a mesh: its primitives have as many each.
fn targets(document: &Document, mesh: u32) -> usize {
    let primitives = document.meshes.get(mesh as usize).map_or(&[][..], |m| &m.primitives);
    primitives.iter().filter_map(|p| p.targets.as_ref()).map(Vec::len).max().unwrap_or(0)
}

/// The node and the property that a channel moves, or why it is not followed.
fn target(json: &TargetJson) -> Result<(u32, Property), &'static str> {
    if json.path == "pointer" {
        let pointer = json.extensions.get("KHR_animation_pointer").map(|e| &e["pointer"]);
        let pointer = pointer.and_then(Value::as_str).ok_or("a pointer that is missing")?;
        return pointed(pointer).ok_or("a pointer to what moves no triangle, or is not known");
    }
    let property = Property::of(&json.path).ok_or("a path that is not known")?;
    Ok((json.node.ok_or("no node as its target")?, property))
}

/// `/nodes/N/translation` and its like.
fn pointed(pointer: &str) -> Option<(u32, Property)> {
    let mut parts = pointer.strip_prefix("/nodes/")?.split('/');
    let (node, property) = (parts.next()?, parts.next()?);
    // An index of JSON has no sign and no leading zero.
    let digits =
        node.bytes().all(|b| b.is_ascii_digit()) && (node == "0" || !node.starts_with('0'));
    match parts.next() {
        None if digits => Some((node.parse().ok()?, Property::of(property)?)),
        _ => None,
    }
}

fn described(target: &TargetJson) -> String {
    let pointer = target.extensions.get("KHR_animation_pointer").map(|e| &e["pointer"]);
    shorten(pointer.and_then(Value::as_str).unwrap_or(&target.path))
}
