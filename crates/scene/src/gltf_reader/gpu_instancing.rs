//! EXT_mesh_gpu_instancing: the transforms of one node's instances.
//!
//! Source: the extension's specification. Node from instance = T * R * S, each from an accessor
//! that may be absent; all accessors have the same number of elements. Rotations may be
//! normalized integers; as they are normalized here, their scale does not matter.

use std::collections::BTreeMap;

use glam::{DAffine3, DQuat, DVec3};

use super::{
    accessors::{Accessors, DATALESS_INSTANCES, Elements, ROTATIONS, SCALES, TRANSLATIONS, Use},
    nodes::rotation,
};
use crate::{Cause, SceneError};

/// Node from instance, for each instance.
pub fn transforms(
    accessors: &Accessors,
    attributes: &BTreeMap<String, u32>,
) -> Result<Vec<DAffine3>, SceneError> {
    let mut count: Option<usize> = None;
    let mut elements = |use_as: &Use| -> Result<Option<Elements>, SceneError> {
        let Some(&accessor) = attributes.get(use_as.name) else { return Ok(None) };
        let found = accessors.elements(accessor, use_as)?;
        let expected = *count.get_or_insert(found.count);
        if found.count != expected {
            let (count, expected) = (found.count as u64, expected as u64);
            return Err(
                Cause::CountMismatch { accessor, use_as: use_as.name, count, expected }.into()
            );
        }
        Ok(Some(found))
    };
    let translations = elements(&TRANSLATIONS)?.map(|e| e.vectors::<3>()).transpose()?;
    let rotations = elements(&ROTATIONS)?.map(|e| e.vectors::<4>()).transpose()?;
    let scales = elements(&SCALES)?.map(|e| e.vectors::<3>()).transpose()?;
    let count = match count {
        Some(count) => count,
        None => identities(accessors, attributes)?,
    };
    let vector = |v: [f32; 3]| DVec3::from_array(v.map(f64::from));
    (0..count)
        .map(|i| {
            let scale = scales.as_ref().map_or(DVec3::ONE, |s| vector(s[i]));
            let translation = translations.as_ref().map_or(DVec3::ZERO, |t| vector(t[i]));
            let turn = match &rotations {
                Some(rotations) => rotation(rotations[i].map(f64::from))?,
                None => DQuat::IDENTITY,
            };
            Ok(DAffine3::from_scale_rotation_translation(scale, turn, translation))
        })
        .collect()
}

/// Number of instances of a node whose attributes place nothing.
fn identities(
    accessors: &Accessors,
    attributes: &BTreeMap<String, u32>,
) -> Result<usize, SceneError> {
    let Some((name, &accessor)) = attributes.iter().next() else {
        let reason = "it has no attributes".into();
        return Err(
            Cause::ExtensionMalformed { extension: "EXT_mesh_gpu_instancing", reason }.into()
        );
    };
    let count = accessors.get(accessor, || name.clone())?.count.0;
    let limit = DATALESS_INSTANCES;
    if count > limit {
        return Err(Cause::AccessorTooLarge { accessor, count, limit }.into());
    }
    Ok(count as usize)
}
