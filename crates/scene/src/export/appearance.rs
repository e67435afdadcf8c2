//! Materials, textures, samplers and images that the meshes of the output refer to.
//!
//! Numbers are given anew in ascending order of the source's. An image that cannot be had takes
//! the textures that need it with it; a material then has no such texture.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::{Map, Value, json};

use super::Warnings;
use super::output::Output;
use super::source::{Source, index};
use super::uri::{self, Target};

/// The lists of the output.
#[derive(Default)]
pub(super) struct Looks {
    pub(super) materials: Vec<Value>,
    pub(super) textures: Vec<Value>,
    pub(super) samplers: Vec<Value>,
    pub(super) images: Vec<Value>,
}

/// New numbers by old ones.
type Numbers = BTreeMap<usize, usize>;

fn numbers(used: impl IntoIterator<Item = usize>) -> Numbers {
    let mut out: Numbers = used.into_iter().map(|old| (old, 0)).collect();
    for (new, number) in out.values_mut().enumerate() {
        *number = new;
    }
    out
}

/// Renumbers the materials of `meshes` and collects what they refer to. `path` is that of the
/// source file; images are looked for beside it.
pub(super) fn collect(
    source: &Source,
    path: &Path,
    meshes: &mut [Value],
    output: &mut Output,
    warnings: &mut Warnings,
) -> Looks {
    let mut looks = Looks::default();
    let material_numbers = numbers(primitives(meshes).filter_map(|p| index(&p["material"])));
    for primitive in primitives(meshes) {
        if let Some(new) = index(&primitive["material"]).and_then(|old| material_numbers.get(&old))
        {
            primitive["material"] = (*new).into();
        }
    }
    looks.materials =
        material_numbers.keys().map(|&m| source.entry("materials", m).clone()).collect();

    // Textures whose images are there.
    let mut used = vec![];
    for material in &mut looks.materials {
        each_texture(material, &mut |texture| {
            used.push(texture);
            Some(texture)
        });
    }
    let mut images: BTreeMap<usize, Option<Value>> = BTreeMap::new();
    let mut textures: BTreeMap<usize, Value> = BTreeMap::new();
    for old in numbers(used).into_keys() {
        let mut texture = source.entry("textures", old).clone();
        let found = keep_sources(&mut texture, |image| {
            let load = || load(source, path, image, output, warnings);
            images.entry(image).or_insert_with(load).is_some()
        });
        if found {
            textures.insert(old, texture);
        } else {
            warnings.add("a texture without an image is left out", format!("texture {old}"));
        }
    }
    let texture_numbers = numbers(textures.keys().copied());
    for material in &mut looks.materials {
        each_texture(material, &mut |old| texture_numbers.get(&old).copied());
    }
    let image_numbers = numbers(images.iter().filter(|(_, i)| i.is_some()).map(|(n, _)| *n));
    looks.images = images.into_values().flatten().collect();
    let sampler_numbers = numbers(textures.values().filter_map(|t| index(&t["sampler"])));
    looks.samplers = sampler_numbers.keys().map(|&s| source.entry("samplers", s).clone()).collect();
    for mut texture in textures.into_values() {
        each_source(&mut texture, &mut |old| image_numbers.get(&old).copied());
        if let Some(new) = index(&texture["sampler"]).and_then(|s| sampler_numbers.get(&s)) {
            texture["sampler"] = (*new).into();
        }
        looks.textures.push(texture);
    }
    looks
}

fn primitives(meshes: &mut [Value]) -> impl Iterator<Item = &mut Value> {
    meshes.iter_mut().filter_map(|m| m["primitives"].as_array_mut()).flatten()
}

/// Calls `renumber` for the index of every texture of a material; `None` removes the texture.
/// A texture is an object with an `index` under a name that ends in `Texture`.
fn each_texture(value: &mut Value, renumber: &mut impl FnMut(usize) -> Option<usize>) {
    match value {
        Value::Array(list) => list.iter_mut().for_each(|v| each_texture(v, renumber)),
        Value::Object(object) => {
            let mut removed = vec![];
            for (key, value) in object.iter_mut().filter(|(key, _)| *key != "extras") {
                match index(&value["index"]).filter(|_| key.ends_with("Texture")) {
                    Some(old) => match renumber(old) {
                        Some(new) => value["index"] = new.into(),
                        None => removed.push(key.clone()),
                    },
                    None => each_texture(value, renumber),
                }
            }
            removed.iter().for_each(|key| drop(object.remove(key)));
        }
        _ => {}
    }
}

/// Calls `renumber` for every `source` of a texture, also in extensions for other formats;
/// `None` removes it.
fn each_source(texture: &mut Value, renumber: &mut impl FnMut(usize) -> Option<usize>) {
    let mut renumber_in = |object: &mut Map<String, Value>| {
        let Some(old) = object.get("source").and_then(index) else { return true };
        match renumber(old) {
            Some(new) => drop(object.insert("source".into(), new.into())),
            None => drop(object.remove("source")),
        }
        object.contains_key("source")
    };
    let Some(object) = texture.as_object_mut() else { return };
    renumber_in(object);
    if let Some(Value::Object(extensions)) = object.get_mut("extensions") {
        extensions.retain(|_, e| e.as_object_mut().is_none_or(&mut renumber_in));
        if extensions.is_empty() {
            object.remove("extensions");
        }
    }
}

/// Removes the sources of a texture that `is_there` denies; true when one is left.
fn keep_sources(texture: &mut Value, mut is_there: impl FnMut(usize) -> bool) -> bool {
    let mut found = false;
    each_source(texture, &mut |image| {
        let there = is_there(image);
        found |= there;
        there.then_some(image)
    });
    found
}

/// An image, embedded; `None` with a warning when it cannot be had.
fn load(
    source: &Source,
    path: &Path,
    number: usize,
    output: &mut Output,
    warnings: &mut Warnings,
) -> Option<Value> {
    let json = source.entry("images", number);
    let place = |what: &str| format!("image {number}, {what}");
    let bytes = match (json["uri"].as_str(), index(&json["bufferView"])) {
        (Some(text), _) => match uri::resolve(text) {
            Ok(Target::Data(bytes)) => Some(bytes),
            Ok(Target::File(name)) => {
                let file = path.parent().unwrap_or(Path::new("")).join(&name);
                // Opening a named pipe would wait for a writer.
                let regular = std::fs::metadata(&file).is_ok_and(|m| m.is_file());
                let read = if regular { std::fs::read(&file).ok() } else { None };
                if read.is_none() {
                    warnings.add("an image file cannot be read and is left out", place(&name));
                }
                read
            }
            Err(_) => {
                warnings.add("the URI of an image is not followed; it is left out", place("`uri`"));
                None
            }
        },
        (None, Some(view)) => source.view(view).map(|(bytes, _)| bytes.to_vec()),
        (None, None) => None,
    }?;
    // The bytes know better than the file's author.
    let kind = media_type(&bytes).or_else(|| json["mimeType"].as_str());
    let Some(kind) = kind.filter(|_| !bytes.is_empty()) else {
        warnings.add("an image is of an unknown kind and left out", place("no `mimeType`"));
        return None;
    };
    let mut out = json!({ "mimeType": kind, "bufferView": output.image(bytes) });
    for key in ["name", "extras"] {
        if let Some(value) = json.get(key) {
            out[key] = value.clone();
        }
    }
    Some(out)
}

/// The media type of an image by its first bytes.
fn media_type(bytes: &[u8]) -> Option<&'static str> {
    let starts = |magic: &[u8]| bytes.starts_with(magic);
    if starts(b"\x89PNG") {
        Some("image/png")
    } else if starts(b"\xff\xd8\xff") {
        Some("image/jpeg")
    } else if starts(b"\xabKTX 20") {
        Some("image/ktx2")
    } else if starts(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
        Some("image/webp")
    } else if starts(b"DDS ") {
        Some("image/vnd-ms.dds")
    } else {
        None
    }
}
