//! From committed parts to a published dataset.
//!
//! Promise: the dataset holds every cell of the plan, in order, or is not published (JB-2); it is
//! a function of the scene and the configuration, whoever solved what (VI-3).

use futures::{StreamExt, TryStreamExt, stream};
use sightline_jobs::{Plan, Task};
use sightline_store::{
    BakeStore, CellRow, DatasetWriter, Description, Numbering, ObjectRow, PartKind, Published,
    SceneObject, SceneSource, decode_cell_part, decode_object_part, keys,
};

use crate::CoordinatorError;
use crate::journal::Journal;

/// Tasks whose parts are read ahead while the dataset is written.
const READ_AHEAD: usize = 4;

/// The last step of a bake, behind a seam: tests of the protocol need no scene.
#[tonic::async_trait]
pub trait Publish: Send + Sync {
    /// Writes the dataset of a plan whose tasks are all committed, and makes it current.
    ///
    /// # Errors
    /// When parts are damaged, or the store fails.
    async fn publish(&self, journal: &Journal, plan: &Plan) -> Result<Published, CoordinatorError>;
}

/// Publishes the real dataset.
#[derive(Clone, Debug)]
pub struct DatasetPublisher {
    /// The objects of the scene.
    pub objects: Vec<SceneObject>,
    /// From primitive numbers to glTF triangles.
    pub numbering: Numbering,
    /// The scene, for the manifest.
    pub source: SceneSource,
}

#[tonic::async_trait]
impl Publish for DatasetPublisher {
    async fn publish(&self, journal: &Journal, plan: &Plan) -> Result<Published, CoordinatorError> {
        let store: &BakeStore = journal.store();
        let mut writer = DatasetWriter::new(store, self.objects.clone(), plan.timeline())?;
        let reads: Vec<_> = plan.final_tasks().map(|task| read_rows(journal, plan, task)).collect();
        let mut parts = stream::iter(reads).buffered(READ_AHEAD);
        while let Some(rows) = parts.try_next().await? {
            for (cell, objects) in &rows {
                writer.push_cell(cell, objects).await?;
            }
        }
        let about = Description {
            scene: self.source.clone(),
            config: serde_json::from_str(&plan.config.canonical_json())
                .map_err(|error| CoordinatorError::Defect(error.to_string()))?,
            config_hash: plan.config.hash(),
            skipped: plan.skipped.0.clone(),
        };
        let manifest = writer.finish(&self.numbering, about).await?;
        Ok(sightline_store::publish(store, &manifest).await?)
    }
}

/// The rows of a cell: that of all states, those of its runs where it has several, and its (cell, object)
/// rows.
type CellRows = (Vec<CellRow>, Vec<ObjectRow>);

/// The rows of a task at the end, one entry a cell of the plan.
async fn read_rows(
    journal: &Journal,
    plan: &Plan,
    task: &Task,
) -> Result<Vec<CellRows>, CoordinatorError> {
    let key = keys::commit(&plan.bake_id, task.id.0);
    let Some(commit) = journal.commit(task.id).await? else {
        return Err(journal.damaged(&key, &"it is missing"));
    };
    let part_of = |kind| {
        let wanted = keys::part(&plan.bake_id, task.id.0, &commit.attempt, kind);
        commit.parts.iter().find(|part| part.key == wanted)
    };
    let (Some(cells), Some(objects)) = (part_of(PartKind::Cells), part_of(PartKind::Objects))
    else {
        return Err(journal.damaged(&key, &"it does not name a cells and an objects part"));
    };
    let rows = decode_cell_part(&cells.key, journal.part(cells).await?.into())?;
    let pairs = decode_object_part(&objects.key, journal.part(objects).await?.into())?;
    let by_cell = rows.chunk_by(|a, b| a.cell.id == b.cell.id);
    let planned = plan.cells_of(task.id);
    if !by_cell.clone().map(|own| &own[0].cell).eq(planned.iter().map(|cell| &cell.cell)) {
        return Err(journal.damaged(&cells.key, &"it does not hold the cells of its task"));
    }
    let mut pairs = pairs.into_iter().peekable();
    let mut out = Vec::with_capacity(planned.len());
    for rows in by_cell {
        let mut own = Vec::new();
        while let Some(pair) = pairs.next_if(|pair| pair.cell == rows[0].cell.id) {
            own.push(pair);
        }
        out.push((rows.to_vec(), own));
    }
    if pairs.next().is_some() {
        return Err(journal.damaged(&objects.key, &"it holds rows of cells of other tasks"));
    }
    Ok(out)
}
