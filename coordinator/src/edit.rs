//! What a bake can take over from an earlier one into the same store.
//!
//! Every bake of a scene at rest leaves what its scene is made of (`bake/<bake>/content.bin`). The next one
//! compares, chooses the bake that has most in common with it, and writes down what is the same
//! (`bake/<bake>/edit.bin`), created only if absent: all coordinators and workers of a bake see the same
//! edit. Workers take over what the edit has no part in (`sightline_worker`); the dataset is that of a bake
//! from scratch.
//!
//! A bake has something in common with one of another scene only where everything else that results depend
//! on is the same: what the solver and the accuracy are asked for, and the version of this software, as
//! another one may compute other results.

use std::collections::BTreeMap;

use prost::Message;
use sightline_geometry::Granularity;
use sightline_jobs::{FORMAT_VERSION, Plan};
use sightline_proto::v1;
use sightline_scene::{Edit, ObjectHash, SceneContent};
use sightline_store::{BakeStore, keys};

use crate::CoordinatorError;

/// What a bake has in common with an earlier one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Common {
    /// The earlier bake.
    pub bake: String,
    /// Objects of the scene.
    pub objects: u64,
    /// Of these, those that are the same.
    pub same: u64,
}

/// Finds out what a bake has in common with earlier ones in the store, and writes it down for workers,
/// unless that was done before. `content` is that of its scene; without one there is nothing to compare.
/// To be called before the bake starts.
///
/// # Errors
/// What the store reports.
pub async fn compare(
    store: &BakeStore,
    plan: &Plan,
    content: Option<&SceneContent>,
) -> Result<Option<Common>, CoordinatorError> {
    let is_traced = plan.config.solver.granularity == Granularity::Triangle;
    let Some(content) = content.filter(|_| is_traced) else { return Ok(None) };
    let results = results_of(plan);
    let bake = &plan.bake_id;
    store.create(&keys::content(bake), encode(content, &results)).await?;
    if let Some(bytes) = store.get_if_exists(&keys::edit(bake)).await? {
        // Damage makes it worthless to workers, not the bake.
        let read = v1::Edit::decode(bytes).unwrap_or_default();
        let same = read.same.iter().map(|same| u64::from(same.objects)).sum();
        let objects = content.objects.len() as u64;
        return Ok((!read.bake.is_empty()).then_some(Common { bake: read.bake, objects, same }));
    }
    let mut best: Option<(u64, String, Edit)> = None;
    let mut bakes: Vec<String> = store.list(keys::BAKE_FOLDER).await?;
    bakes.sort_unstable();
    for other in bakes.iter().filter_map(|key| keys::content_bake(key)).filter(|id| id != bake) {
        let Some(bytes) = store.get_if_exists(&keys::content(other)).await? else { continue };
        let Some(before) = decode(&bytes, &results) else { continue };
        let Some(edit) = Edit::between(&before, content).filter(|e| e.is_small(content)) else {
            continue;
        };
        let primitives = edit.primitives();
        if best.as_ref().is_none_or(|(most, ..)| primitives > *most) {
            best = Some((primitives, other.to_owned(), edit));
        }
    }
    let (other, edit) = best.map(|(_, other, edit)| (other, edit)).unwrap_or_default();
    store.create(&keys::edit(bake), encode_edit(&other, &edit)).await?;
    Ok((!other.is_empty()).then(|| Common {
        bake: other,
        objects: content.objects.len() as u64,
        same: edit.objects(),
    }))
}

/// All that results depend on beside the scene and the places of cells.
fn results_of(plan: &Plan) -> String {
    let config: BTreeMap<&str, serde_json::Value> = BTreeMap::from([
        ("solver", serde_json::to_value(plan.config.solver).unwrap_or_default()),
        ("accuracy", serde_json::to_value(plan.config.accuracy).unwrap_or_default()),
    ]);
    let config = serde_json::to_string(&config).unwrap_or_default();
    format!("sightline {} format {FORMAT_VERSION} {config}", env!("CARGO_PKG_VERSION"))
}

fn encode(content: &SceneContent, results: &str) -> Vec<u8> {
    v1::SceneContent {
        results: results.to_owned(),
        bounds: content.bounds.to_vec(),
        placement_reach: content.placement_reach,
        hashes: content.objects.iter().flat_map(|(hash, _)| *hash).collect(),
        primitives: content.objects.iter().map(|(_, primitives)| *primitives).collect(),
    }
    .encode_to_vec()
}

/// The content of an earlier scene, when it is readable and its results are like those of this bake.
fn decode(bytes: &[u8], results: &str) -> Option<SceneContent> {
    let read = v1::SceneContent::decode(bytes).ok().filter(|read| read.results == results)?;
    let (hashes, rest) = read.hashes.as_chunks::<{ size_of::<ObjectHash>() }>();
    if !rest.is_empty() || hashes.len() != read.primitives.len() {
        return None;
    }
    // Numbers of primitives have 32 bits.
    read.primitives.iter().try_fold(0u32, |sum, primitives| sum.checked_add(*primitives))?;
    Some(SceneContent {
        bounds: read.bounds.try_into().ok()?,
        placement_reach: read.placement_reach,
        objects: hashes.iter().copied().zip(read.primitives).collect(),
    })
}

fn encode_edit(bake: &str, edit: &Edit) -> Vec<u8> {
    let same = edit.same.iter().map(|same| v1::SameObjects {
        old_object: same.object[0],
        new_object: same.object[1],
        old_primitive: same.primitive[0],
        new_primitive: same.primitive[1],
        objects: same.objects,
        primitives: same.primitives,
    });
    v1::Edit { bake: bake.to_owned(), same: same.collect() }.encode_to_vec()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn content() -> SceneContent {
        let objects = vec![([1; 16], 4), ([2; 16], 7)];
        SceneContent { bounds: [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], placement_reach: 9.0, objects }
    }

    #[test]
    fn content_is_read_as_it_was_written() {
        let bytes = encode(&content(), "results");
        assert_eq!(decode(&bytes, "results"), Some(content()));
        assert_eq!(decode(&bytes, "others"), None, "other results are not comparable");
    }

    #[test]
    fn damaged_content_is_no_content() {
        let mut damaged = v1::SceneContent::decode(&encode(&content(), "")[..]).unwrap();
        damaged.primitives = vec![u32::MAX, 1];
        assert_eq!(decode(&damaged.encode_to_vec(), ""), None, "more primitives than numbers");
        damaged.primitives = vec![1];
        assert_eq!(decode(&damaged.encode_to_vec(), ""), None, "an object without a number");
        damaged.primitives = vec![1, 1];
        damaged.bounds.pop();
        assert_eq!(decode(&damaged.encode_to_vec(), ""), None, "half a box");
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_without_a_panic(bytes in proptest::collection::vec(any::<u8>(), 0..99)) {
            let _ = decode(&bytes, "");
        }
    }
}
