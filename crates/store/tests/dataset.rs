//! A dataset comes back as it was written, appears at once, and shows its damage.

mod support;

use std::sync::Arc;
use std::sync::atomic::Ordering;

use futures::TryStreamExt;
use glam::DVec3;
use object_store::memory::InMemory;
use sightline_geometry::{CellId, PrimitiveId, PrimitiveSet};
use sightline_store::{
    BakeStore, CellEntry, CellRow, Dataset, DatasetWriter, ErrorClass, FileKind, Limits, ObjectRow,
    Published, StoreError, Weight, keys, publish,
};
use support::Sample;
use support::faulty::{Fault, Faulty};

/// Small enough for several files of the larger samples, large enough for their footers.
const SMALL: Limits = Limits { file_bytes_max: 400_000 };

async fn published(sample: &Sample) -> BakeStore {
    let store = BakeStore::in_memory();
    let manifest = sample.write(&store, Limits::default()).await;
    publish(&store, &manifest).await.unwrap();
    store
}

#[tokio::test]
async fn a_dataset_comes_back_as_it_was_written() {
    let sample = Sample::golden();
    let store = published(&sample).await;
    let dataset = Dataset::open(&store).await.unwrap();
    assert_eq!(dataset.cells().len(), sample.cells.len());
    for (row, pairs) in &sample.cells {
        assert_eq!(&dataset.cell(row.cell.id).await.unwrap(), row);
        assert_eq!(&dataset.object_rows(row.cell.id).await.unwrap(), pairs);
    }
    let rows: Vec<_> = dataset.cell_rows().try_collect().await.unwrap();
    assert_eq!(rows, sample.all_rows());
    let pairs: Vec<_> = dataset.all_object_rows().try_collect().await.unwrap();
    assert!(pairs.iter().eq(sample.cells.iter().flat_map(|(_, pairs)| pairs)));
    assert_eq!(dataset.objects().await.unwrap(), sample.objects);
    let numbering = dataset.numbering().await.unwrap();
    assert_eq!(numbering, sample.numbering);
    let place = numbering.locate(PrimitiveId(0)).unwrap();
    assert_eq!((place.instance.node, place.triangle), (1, 3));
    assert!(numbering.locate(PrimitiveId(u32::MAX)).is_none());
    assert_eq!(dataset.cell(CellId(999)).await.unwrap_err().class(), ErrorClass::NotFound);

    let center = sample.cells[9].0.cell.center();
    assert_eq!(dataset.cell_at(center), Some(CellId(9)));
    assert_eq!(dataset.cell_at(center + DVec3::Y), None);

    let report = Dataset::check(&store).await.unwrap();
    assert!(report.is_sound(), "{:?}", report.problems);
    assert_eq!(report.cells, 24);
}

#[tokio::test]
async fn large_datasets_take_several_files_below_the_limit() {
    let sample = Sample::new(3000, 300);
    let store = BakeStore::in_memory();
    let manifest = sample.write(&store, SMALL).await;
    for kind in [FileKind::Cells, FileKind::Objects] {
        assert!(manifest.files_of(kind).count() > 2, "{kind:?}: {:?}", manifest.files);
    }
    assert!(manifest.files.iter().all(|f| f.bytes <= SMALL.file_bytes_max as u64));
    publish(&store, &manifest).await.unwrap();
    let dataset = Dataset::open(&store).await.unwrap();
    for (row, pairs) in sample.cells.iter().step_by(97) {
        assert_eq!(&dataset.cell(row.cell.id).await.unwrap(), row);
        assert_eq!(&dataset.object_rows(row.cell.id).await.unwrap(), pairs);
    }
    let report = Dataset::check(&store).await.unwrap();
    assert!(report.is_sound(), "{:?}", report.problems);
}

#[tokio::test]
async fn equal_rows_give_equal_bytes() {
    let sample = Sample::golden();
    let (a, b) = (published(&sample).await, published(&sample).await);
    let keys = a.list("").await.unwrap();
    assert_eq!(keys, b.list("").await.unwrap());
    for key in keys {
        assert_eq!(a.get(&key).await.unwrap(), b.get(&key).await.unwrap(), "{key}");
    }
}

#[tokio::test]
async fn pages_in_the_index_hold_the_cells_set_and_weights() {
    let sample = Sample::golden();
    let store = published(&sample).await;
    let dataset = Dataset::open(&store).await.unwrap();
    let (mut ends, mut weight_pages) = (Vec::new(), Vec::new());
    let of_cell = |cell: &CellEntry| {
        let runs = dataset.runs(cell.cell.id);
        let behind = if runs.len() > 1 { runs } else { &[] };
        let mut entries = [std::slice::from_ref(cell), behind].concat();
        entries.sort_by_key(|entry| (entry.set.row_group, entry.set.row));
        entries
    };
    for entry in &dataset.cells().iter().flat_map(of_cell).collect::<Vec<_>>() {
        assert_eq!(entry.set.page_row, 0, "a page holds one set");
        let range = u64::from(entry.set.page_offset)
            ..u64::from(entry.set.page_offset + entry.set.page_bytes);
        let page = store.get_range(&entry.set.file, range.clone()).await.unwrap();
        let weights = u64::from(entry.set.weights_offset)
            ..u64::from(entry.set.weights_offset + entry.set.weights_bytes);
        assert_eq!(
            store.get_range(&entry.set.file, weights.clone()).await.unwrap()[..2],
            [0x15, 0]
        );
        weight_pages.push(weights);
        // A page header is a thrift struct whose first field, an i32 under number 1, is the page
        // type; 0 stands for DATA_PAGE.
        assert_eq!(page[..2], [0x15, 0x00]);
        ends.push(range);
    }
    for pages in [ends, weight_pages] {
        assert!(pages.windows(2).all(|w| w[0].end == w[1].start), "pages follow each other");
    }
}

#[tokio::test]
async fn a_cell_takes_few_requests_and_few_bytes() {
    let sample = Sample::new(3000, 300);
    let inner = Arc::new(InMemory::new());
    let plain = Faulty::over(&inner, Fault::None).bake_store();
    let manifest = sample.write(&plain, Limits::default()).await;
    publish(&plain, &manifest).await.unwrap();

    let counted = Faulty::over(&inner, Fault::None);
    let store = counted.bake_store();
    let dataset = Dataset::open(&store).await.unwrap();
    dataset.cell(CellId(0)).await.unwrap();
    let before =
        (counted.requests.load(Ordering::Relaxed), counted.bytes_read.load(Ordering::Relaxed));
    dataset.cell(CellId(1500)).await.unwrap();
    let requests = counted.requests.load(Ordering::Relaxed) - before.0;
    let bytes = counted.bytes_read.load(Ordering::Relaxed) - before.1;
    let file = manifest.files_of(FileKind::Cells).next().unwrap();
    assert_eq!(requests, 1, "a warm cell takes one request");
    assert!(bytes < file.bytes / 8, "{bytes} of {}", file.bytes);
}

#[tokio::test]
async fn publishing_the_same_again_changes_nothing() {
    let sample = Sample::golden();
    let store = published(&sample).await;
    let manifest = sample.write(&store, Limits::default()).await;
    let again = publish(&store, &manifest).await.unwrap();
    assert_eq!(again, Published { number: 1, changed: false });
    assert_eq!(store.list(keys::MANIFEST_FOLDER).await.unwrap().len(), 1);

    let other = Sample::new(10, 60);
    let manifest = other.write(&store, Limits::default()).await;
    let second = publish(&store, &manifest).await.unwrap();
    assert_eq!(second, Published { number: 2, changed: true });
    assert_eq!(Dataset::open(&store).await.unwrap().cells().len(), 10);

    let manifest = sample.write(&store, Limits::default()).await;
    let third = publish(&store, &manifest).await.unwrap();
    assert_eq!(third, Published { number: 3, changed: true }, "old numbers are not used again");
}

#[tokio::test]
async fn a_crash_at_any_put_leaves_the_old_dataset_or_the_new_one() {
    let (old, new) = (Sample::golden(), Sample::new(10, 40));
    let mut finished = false;
    for puts in 0.. {
        let inner = Arc::new(InMemory::new());
        let sound = Faulty::over(&inner, Fault::None).bake_store();
        let manifest = old.write(&sound, Limits::default()).await;
        publish(&sound, &manifest).await.unwrap();

        let crashing = Faulty::over(&inner, Fault::CrashAfter(puts)).bake_store();
        let outcome = async {
            let manifest = new.try_write(&crashing, Limits::default()).await?;
            publish(&crashing, &manifest).await
        };
        finished = outcome.await.is_ok();
        let cells = Dataset::open(&sound).await.unwrap().cells().len();
        assert_eq!(cells, if finished { 10 } else { 24 }, "after {puts} puts");
        assert!(Dataset::check(&sound).await.unwrap().is_sound(), "after {puts} puts");

        // Starting over finishes, with the same number whatever the crash left behind.
        let manifest = new.write(&sound, Limits::default()).await;
        assert_eq!(publish(&sound, &manifest).await.unwrap().number, 2);
        assert_eq!(Dataset::open(&sound).await.unwrap().cells().len(), 10);
        if finished {
            break;
        }
    }
    assert!(finished);
}

#[tokio::test]
async fn a_missing_file_keeps_a_manifest_from_being_published() {
    let sample = Sample::golden();
    let manifest = sample.write(&BakeStore::in_memory(), Limits::default()).await;
    let store = BakeStore::in_memory();
    assert_eq!(publish(&store, &manifest).await.unwrap_err().class(), ErrorClass::NotFound);
    assert!(store.list("").await.unwrap().is_empty());
}

#[tokio::test]
async fn damage_anywhere_is_found_and_named() {
    let store = published(&Sample::golden()).await;
    for key in store.list("").await.unwrap() {
        let sound = store.get(&key).await.unwrap();
        let regions = 48.min(sound.len());
        for region in 0..regions {
            let mut bytes = sound.to_vec();
            bytes[region * sound.len() / regions] ^= 0x01;
            store.put_pointer(&key, bytes).await.unwrap();
            let named = match Dataset::check(&store).await {
                Ok(report) => report.problems.into_iter().map(|p| p.file).collect(),
                // A damaged pointer may name another version.
                Err(error) => vec![error.to_string()],
            };
            // A pointer to the wrong manifest, and a manifest that is not what the pointer says,
            // look the same.
            let expected = |name: &String| {
                name.contains(&key) || (key == keys::POINTER && name.starts_with("manifests/"))
            };
            assert!(named.iter().any(expected), "region {region} of {key}: {named:?}");
        }
        for cut in [0, 1, sound.len() / 2, sound.len() - 1] {
            store.put_pointer(&key, sound.slice(..cut)).await.unwrap();
            let report = Dataset::check(&store).await.unwrap();
            assert!(report.problems.iter().any(|p| p.file == key), "{key} cut to {cut} bytes");
        }
        store.put_pointer(&key, sound).await.unwrap();
    }
    assert!(Dataset::check(&store).await.unwrap().is_sound());
}

#[tokio::test]
async fn a_damaged_page_does_not_panic_the_reader() {
    let store = published(&Sample::golden()).await;
    let dataset = Dataset::open(&store).await.unwrap();
    let file = dataset.manifest().files_of(FileKind::Cells).next().unwrap().name.clone();
    let sound = store.get(&file).await.unwrap();
    for at in (0..sound.len()).step_by(29) {
        let mut bytes = sound.to_vec();
        bytes[at] ^= 0x5a;
        store.put_pointer(&file, bytes).await.unwrap();
        let fresh = Dataset::open(&store).await.unwrap();
        for entry in fresh.cells().iter().step_by(7) {
            if let Err(error) = fresh.cell(entry.cell.id).await {
                assert!(error.to_string().contains(&file), "{error}");
            }
        }
    }
}

#[tokio::test]
async fn missing_files_are_named() {
    let store = published(&Sample::golden()).await;
    let dataset = Dataset::open(&store).await.unwrap();
    let without = BakeStore::in_memory();
    for key in store.list("").await.unwrap() {
        let file = dataset.manifest().files.iter().find(|f| f.name == key);
        if file.is_none_or(|f| f.kind != FileKind::Cells) {
            without.create(&key, store.get(&key).await.unwrap()).await.unwrap();
        }
    }
    let opened = Dataset::open(&without).await.unwrap();
    let error = opened.cell(CellId(0)).await.unwrap_err();
    assert_eq!(error.class(), ErrorClass::Corrupt);
    assert!(error.to_string().contains("data/cells-"), "{error}");
    let report = Dataset::check(&without).await.unwrap();
    assert_eq!(report.problems.len(), 1);
    assert!(report.problems[0].file.starts_with("data/cells-"));
}

#[tokio::test]
async fn places_without_a_dataset_say_so() {
    let store = BakeStore::in_memory();
    let error = Dataset::open(&store).await.unwrap_err();
    assert!(matches!(error, StoreError::NotADataset { .. }));
    assert!(error.to_string().contains("current.json"), "{error}");
    assert!(matches!(Dataset::check(&store).await, Err(StoreError::NotADataset { .. })));
    store.create(&keys::plan("b"), "x").await.unwrap();
    let error = Dataset::open(&store).await.unwrap_err();
    assert!(error.to_string().contains("published nothing yet"), "{error}");
}

#[tokio::test]
async fn later_versions_are_refused_as_such() {
    let store = published(&Sample::golden()).await;
    let pointer = store.get(keys::POINTER).await.unwrap();
    let text = String::from_utf8(pointer.to_vec()).unwrap();
    let later = text.replace("\"version\":3", "\"version\":4,\"more\":true");
    store.put_pointer(keys::POINTER, later).await.unwrap();
    let error = Dataset::open(&store).await.unwrap_err();
    assert!(matches!(error, StoreError::UnsupportedVersion { found: 4, .. }), "{error}");
}

#[tokio::test]
async fn rows_that_break_the_contract_are_refused() {
    let sample = Sample::golden();
    let store = BakeStore::in_memory();
    let clock = || sample.timeline.clone();
    let new = || DatasetWriter::new(&store, sample.objects.clone(), clock()).unwrap();
    let (cell, pairs) = (sample.rows(1), &sample.cells[1].1);

    let mut writer = new();
    writer.push_cell(&cell, pairs).await.unwrap();
    let error = writer.push_cell(&cell, pairs).await.unwrap_err();
    assert!(error.to_string().contains("out of order"), "{error}");
    let error = new().push_cell(&cell, &pairs[1..]).await.unwrap_err();
    assert!(error.to_string().contains("the rows of its objects have"), "{error}");
    let mut gap = sample.objects.clone();
    gap.remove(3);
    assert_eq!(
        DatasetWriter::new(&store, gap, clock()).err().unwrap().class(),
        ErrorClass::FixInput
    );
    let mut numbering = sample.numbering.clone();
    numbering.instances.pop();
    let error = new().finish(&numbering, sample.description.clone()).await.unwrap_err();
    assert_eq!(error.class(), ErrorClass::FixInput);
}

#[tokio::test]
async fn a_budget_keeps_the_most_important_and_breaks_ties_by_number() {
    let mut row = Sample::golden().cells[1].0.clone();
    row.set = PrimitiveSet::from_sorted([2, 5, 6, 9, 40]);
    row.weights = [3, 9, 0, 9, 200].map(Weight::from_code).to_vec();
    let order: Vec<u32> = row.by_importance().iter().map(|(p, _)| p.0).collect();
    assert_eq!(order, [40, 5, 9, 2, 6], "members without a weight come last");
    assert_eq!(row.most_important(2), PrimitiveSet::from_sorted([5, 40]));
    assert_eq!(row.most_important(0), PrimitiveSet::default());
    assert_eq!(row.most_important(99), row.set);
}

#[tokio::test]
async fn weights_that_contradict_their_objects_are_refused_with_cell_and_remedy() {
    let sample = Sample::golden();
    let store = BakeStore::in_memory();
    let (cell, pairs) = &sample.cells[1];
    let refused = async |cell: CellRow| {
        let (objects, timeline) = (sample.objects.clone(), sample.timeline.clone());
        let mut writer = DatasetWriter::new(&store, objects, timeline).unwrap();
        let error = writer.push_cell(&[cell], pairs).await.unwrap_err().to_string();
        assert!(error.contains("cell 1") && error.contains("bake again"), "{error}");
        error
    };
    let mut fewer = cell.clone();
    fewer.weights.pop();
    let error = refused(fewer).await;
    assert!(error.contains("weights for"), "{error}");
    let mut heavier = cell.clone();
    heavier.weights[0] = Weight::from_share(0.5);
    let error = refused(heavier).await;
    assert!(error.contains(&format!("object {}", pairs[0].object)), "{error}");
    let mut whole = cell.clone();
    whole.weights.fill(Weight::from_share(1.0));
    let _ = refused(whole).await;
}

#[tokio::test]
async fn a_dataset_without_cells_is_a_dataset() {
    let sample = Sample::new(0, 60);
    let store = published(&sample).await;
    let dataset = Dataset::open(&store).await.unwrap();
    assert!(dataset.cells().is_empty());
    assert!(Dataset::check(&store).await.unwrap().is_sound());
    let nothing = published(&Sample::new(0, 0)).await;
    assert!(Dataset::check(&nothing).await.unwrap().is_sound());
}

#[tokio::test]
async fn a_state_has_the_row_of_its_run_and_no_state_that_of_all() {
    let sample = Sample::golden();
    let store = published(&sample).await;
    let dataset = Dataset::open(&store).await.unwrap();
    assert_eq!((dataset.states(), dataset.timeline()), (5, &sample.timeline));
    assert_eq!(dataset.cells().len(), 24, "one entry a cell");
    assert_eq!(dataset.manifest().totals.cell_rows, 24 + 8 * 3);
    for (k, (union, _)) in sample.cells.iter().enumerate() {
        let id = union.cell.id;
        let runs = if sample.runs[k].is_empty() {
            std::slice::from_ref(union)
        } else {
            &sample.runs[k][..]
        };
        assert!(dataset.runs(id).iter().map(|r| r.states()).eq(runs.iter().map(CellRow::states)));
        let sets = dataset.state_sets(id).await.unwrap();
        assert_eq!((sets.union(), sets.runs().len()), (union.set.clone(), runs.len()));
        for state in 0..5 {
            let run = runs.iter().find(|run| run.states().contains(&state)).unwrap();
            assert_eq!(&dataset.cell_in_state(id, state).await.unwrap(), run);
            assert_eq!(sets.at(state), &run.set);
        }
        let error = dataset.cell_in_state(id, 5).await.unwrap_err();
        assert_eq!(error.class(), ErrorClass::NotFound);
    }
    assert!(dataset.runs(CellId(999)).is_empty());
}

/// Damages the rows of a cell and of its objects.
type Change<'a> = &'a dyn Fn(&mut Vec<CellRow>, &mut Vec<ObjectRow>);

#[tokio::test]
async fn rows_of_states_that_contradict_each_other_are_refused() {
    let sample = Sample::golden();
    let store = BakeStore::in_memory();
    let (rows, pairs) = (sample.rows(3), sample.cells[3].1.clone());
    let refused = async |change: Change<'_>| {
        let (mut rows, mut pairs) = (rows.clone(), pairs.clone());
        change(&mut rows, &mut pairs);
        let (objects, timeline) = (sample.objects.clone(), sample.timeline.clone());
        let mut writer = DatasetWriter::new(&store, objects, timeline).unwrap();
        writer.push_cell(&rows, &pairs).await.unwrap_err().to_string()
    };
    let cases: [(Change<'_>, &str); 9] = [
        (&|rows, _| rows.clear(), "has no row"),
        (&|rows, _| drop(rows.remove(0)), "is not of all 5 states"),
        (&|rows, _| rows.swap(1, 2), "ascending order"),
        (&|rows, _| rows[2].last_state = 9, "states that the scene does not have"),
        (&|rows, _| drop(rows.pop()), "do not take each state once"),
        (&|rows, _| rows[1].cell.id = CellId(4), "of different cells"),
        (&|rows, _| rows[3].set = rows[1].set.clone(), "have equal sets"),
        (&|rows, _| rows[0].set = rows[1].set.clone(), "is not the union of its runs"),
        (&|_, pairs| pairs[0].last_state = 3, "that its row says"),
    ];
    for (change, says) in cases {
        let error = refused(change).await;
        assert!(error.contains(says), "{error}");
    }
}
