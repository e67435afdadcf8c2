//! Chunk files: what is written is read back, and damage is found.

use std::fs;

use sightline_geometry::{Mesh, Residency};

use super::*;

/// Small triangles on a spiral.
fn mesh(count: u32) -> (Mesh, Array<u32>) {
    let corner = |t: u32, k: u32| {
        let at = (t * 3 + k) as f32;
        [at % 7.0, at * 0.25, (at * 1.7) % 5.0]
    };
    let positions = (0..count).flat_map(|t| [0, 1, 2].map(|k| corner(t, k))).collect();
    let triangles: Vec<[u32; 3]> = (0..count).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    let (mesh, order) = Mesh::new(positions, &triangles);
    (mesh, order.into())
}

fn bodies() -> Vec<StoredBody> {
    let body =
        |name, body, degenerate| StoredBody { name, odd_indices: name.1 == 1, degenerate, body };
    vec![
        body((0, 0), Some(mesh(3)), None),
        body((0, 1), None, Some((2, vec![0, 1]))),
        body((4, 0), Some(mesh(100)), Some((1, vec![7]))),
    ]
}

const NAMES: [(u32, u32); 3] = [(0, 0), (0, 1), (4, 0)];

struct Place {
    folder: tempfile::TempDir,
    limit: MemoryLimit,
    keeper: Arc<Keeper>,
    key: blake3::Hash,
}

impl Place {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let limit =
            MemoryLimit { strict: false, ..MemoryLimit::new(1 << 20, folder.path().into()) };
        let keeper = Arc::new(Keeper::new(&limit).unwrap());
        Self { folder, limit, keeper, key: key("files", "First") }
    }

    fn path(&self) -> PathBuf {
        folder::file_of(self.folder.path(), &self.key)
    }

    /// Opens the file; the flag tells whether it was made.
    fn open(&self) -> (Vec<StoredBody>, Option<String>, bool) {
        let mut made = false;
        let (found, note) = read_or_make(&self.limit, &self.keeper, &self.key, &NAMES, |file| {
            made = true;
            bodies().iter().try_for_each(|body| file.put(body))
        })
        .unwrap();
        (found, note, made)
    }
}

fn assert_same(found: &[StoredBody], expected: &[StoredBody]) {
    assert_eq!(found.len(), expected.len());
    for (a, b) in found.iter().zip(expected) {
        assert_eq!((a.name, a.odd_indices, &a.degenerate), (b.name, b.odd_indices, &b.degenerate));
        assert_eq!(a.body.is_some(), b.body.is_some());
        let Some(((a, numbers), (b, other))) = a.body.as_ref().zip(b.body.as_ref()) else {
            continue;
        };
        assert_eq!((&a.positions, &a.triangles, numbers), (&b.positions, &b.triangles, other));
        assert_eq!(
            (&a.hierarchy.nodes, a.hierarchy.depth),
            (&b.hierarchy.nodes, b.hierarchy.depth)
        );
        assert_eq!(a.bounds, b.bounds);
        let bytes = |mesh: &Mesh| bytemuck::cast_slice(mesh.hierarchy.wide_nodes()).to_vec();
        let (wide, other): (Vec<u8>, Vec<u8>) = (bytes(a), bytes(b));
        assert_eq!(wide, other);
    }
}

#[test]
fn what_was_written_is_read_back_and_made_once() {
    let place = Place::new();
    let (first, note, made) = place.open();
    assert_same(&first, &bodies());
    assert!(made && note.is_none());
    let (second, note, made) = place.open();
    assert_same(&second, &bodies());
    assert!(!made && note.is_none());
    place.keeper.look();
    assert_same(&first, &second);
}

#[test]
fn the_same_bodies_are_the_same_bytes() {
    let (a, b) = (Place::new(), Place::new());
    let _written = [a.open(), b.open()];
    assert_eq!(fs::read(a.path()).unwrap(), fs::read(b.path()).unwrap());
}

#[test]
fn a_file_with_any_byte_changed_is_made_again_and_named() {
    let place = Place::new();
    place.open();
    let whole = fs::read(place.path()).unwrap();
    for at in (0..whole.len()).step_by(whole.len() / 40).chain([whole.len() - 1]) {
        let mut bytes = whole.clone();
        bytes[at] ^= 1;
        fs::write(place.path(), bytes).unwrap();
        let (found, note, made) = place.open();
        assert!(made, "byte {at}");
        assert_same(&found, &bodies());
        let note = note.expect("it is said");
        assert!(note.contains(&place.path().display().to_string()), "{note}");
        assert_eq!(fs::read(place.path()).unwrap(), whole);
    }
}

#[test]
fn a_file_that_was_cut_short_is_made_again() {
    let place = Place::new();
    place.open();
    let whole = fs::read(place.path()).unwrap();
    for length in [0, 10, 63, 64, 500, whole.len() - 1] {
        fs::write(place.path(), &whole[..length]).unwrap();
        let (found, note, made) = place.open();
        assert!(made && note.is_some(), "{length}");
        assert_same(&found, &bodies());
    }
}

#[test]
fn a_file_of_other_meshes_is_made_again() {
    let place = Place::new();
    place.open();
    let names = [(0, 0), (0, 1), (5, 0)];
    let renamed = || {
        let mut all = bodies();
        all[2].name = names[2];
        all
    };
    let (found, note) = read_or_make(&place.limit, &place.keeper, &place.key, &names, |file| {
        renamed().iter().try_for_each(|body| file.put(body))
    })
    .unwrap();
    assert_same(&found, &renamed());
    assert!(note.is_some_and(|note| note.contains("other meshes")));
}

#[test]
fn a_bake_that_fails_leaves_nothing_behind() {
    let place = Place::new();
    let failed = read_or_make(&place.limit, &place.keeper, &place.key, &NAMES, |file| {
        file.put(&bodies()[0])?;
        Err(Cause::NotAFile.into())
    });
    assert!(failed.is_err());
    assert_eq!(fs::read_dir(place.folder.path()).unwrap().count(), 0);
}

#[test]
fn a_folder_that_cannot_be_made_is_named() {
    let mut place = Place::new();
    let file = place.folder.path().join("file");
    fs::write(&file, "no folder").unwrap();
    place.limit.folder = file.join("below");
    let failed = read_or_make(&place.limit, &place.keeper, &place.key, &NAMES, |_| Ok(()));
    let message = failed.err().expect("it cannot be made").to_string();
    assert!(message.contains("below"), "{message}");
}

#[test]
fn what_a_scene_is_made_from_is_its_key() {
    assert_ne!(key("a", "First"), key("b", "First"));
    assert_ne!(key("a", "First"), key("a", "None"));
    assert_ne!(key("ab", "c"), key("a", "bc"));
    assert_eq!(key("a", "First"), key("a", "First"));
}
