//! What the results of a task depend on, beside the plan: the questions that were asked of the scene.
//!
//! A bake keeps a trace of each segment and cell of a scene at rest, so that a later bake of an edited
//! scene can tell what the edit has no part in (`reuse`). A trace is a function of the plan and the scene
//! like the rows beside it, and equal traces give equal bytes.
//!
//! Cost: some hundred bytes a segment and a cell, and nothing to make: what is recorded was known anyway.

use std::collections::BTreeMap;

use bytes::Bytes;
use glam::DVec3;
use prost::Message;
use sightline_geometry::{CellId, PrimitiveSet, Run, SegmentId, ViewSegment};
use sightline_proto::v1;
use sightline_solver::SegmentTrace;

/// A segment that was solved for a cell alone.
#[derive(Clone, Debug, PartialEq)]
pub struct ExtraTrace {
    /// The segment.
    pub segment: ViewSegment,
    /// Rows of a face of its first pass.
    pub rows: u32,
    /// Where its solve looked.
    pub trace: SegmentTrace,
}

/// What was asked of the scene to finish a cell, beside what its planned segments see.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CellTrace {
    /// Segments that were solved for it alone.
    pub extra: Vec<ExtraTrace>,
    /// Measurements by single rays: the seed, and the number of batches.
    pub batches: Vec<(u64, u32)>,
    /// Measurements of viewpoints: where, the seed of their directions, the number of rays.
    pub viewpoints: Vec<(DVec3, u64, u32)>,
    /// Primitives that rays met and the set lacked.
    pub missing: PrimitiveSet,
}

/// The traces of a task.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Traces {
    /// Of segments.
    pub segments: BTreeMap<SegmentId, SegmentTrace>,
    /// Of cells.
    pub cells: BTreeMap<CellId, CellTrace>,
}

/// Traces that were read are none.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct TraceError(String);

fn damaged(problem: &str) -> TraceError {
    TraceError(problem.to_owned())
}

impl Traces {
    /// The bytes of a part.
    #[must_use]
    pub fn encode(&self) -> Bytes {
        let segments = self
            .segments
            .iter()
            .map(|(id, trace)| v1::SegmentTrace { segment: id.0, ..encode_segment(trace) });
        let cells = self.cells.iter().map(|(id, trace)| encode_cell(*id, trace));
        v1::Traces { segments: segments.collect(), cells: cells.collect() }.encode_to_vec().into()
    }

    /// The traces of a part.
    ///
    /// # Errors
    /// When the bytes are no traces.
    pub fn decode(bytes: Bytes) -> Result<Self, TraceError> {
        let read = v1::Traces::decode(bytes).map_err(|error| TraceError(error.to_string()))?;
        let segments = read
            .segments
            .iter()
            .map(|trace| Ok((SegmentId(trace.segment), decode_segment(trace)?)))
            .collect::<Result<_, TraceError>>()?;
        let cells = read.cells.iter().map(decode_cell).collect::<Result<_, TraceError>>()?;
        Ok(Self { segments, cells })
    }
}

fn encode_set(set: &PrimitiveSet) -> v1::PrimitiveRuns {
    let mut lengths = Vec::with_capacity(2 * set.runs().len());
    let mut end = 0;
    for run in set.runs() {
        lengths.extend([run.first - end, run.end - run.first]);
        end = run.end;
    }
    v1::PrimitiveRuns { lengths }
}

fn decode_set(read: Option<&v1::PrimitiveRuns>) -> Result<PrimitiveSet, TraceError> {
    let mut set = PrimitiveSet::default();
    let mut end = 0u32;
    for pair in read.map_or(&[][..], |runs| &runs.lengths).chunks(2) {
        let &[gap, length] = pair else { return Err(damaged("a run has no length")) };
        let first = end.checked_add(gap);
        let next = first.and_then(|first| first.checked_add(length)).filter(|_| length > 0);
        let (Some(first), Some(next)) = (first, next) else {
            return Err(damaged("a run of primitives is empty or has no end"));
        };
        set.push(Run { first, end: next });
        end = next;
    }
    Ok(set)
}

fn encode_segment(trace: &SegmentTrace) -> v1::SegmentTrace {
    let tiles = |numbers: &Vec<u32>| {
        let mut last = 0;
        let steps = numbers.iter().map(|number| number - std::mem::replace(&mut last, *number));
        v1::Tiles { steps: steps.collect() }
    };
    v1::SegmentTrace {
        segment: 0,
        passes: trace.tiles.iter().map(tiles).collect(),
        grazed: Some(encode_set(&trace.grazed)),
    }
}

fn decode_segment(read: &v1::SegmentTrace) -> Result<SegmentTrace, TraceError> {
    let tiles = |pass: &v1::Tiles| {
        let mut last = 0u32;
        let numbers = pass.steps.iter().map(|step| {
            last = last.checked_add(*step).ok_or_else(|| damaged("a tile has no number"))?;
            Ok(last)
        });
        numbers.collect::<Result<Vec<u32>, TraceError>>()
    };
    let tiles = read.passes.iter().map(tiles).collect::<Result<_, TraceError>>()?;
    Ok(SegmentTrace { tiles, grazed: decode_set(read.grazed.as_ref())? })
}

fn encode_point(p: DVec3) -> Option<v1::Point> {
    Some(v1::Point { x: p.x, y: p.y, z: p.z })
}

fn decode_point(read: Option<&v1::Point>) -> Result<DVec3, TraceError> {
    let point = read.map(|p| DVec3::new(p.x, p.y, p.z)).filter(|p| p.is_finite());
    point.ok_or_else(|| damaged("a point is missing or not finite"))
}

fn encode_cell(cell: CellId, trace: &CellTrace) -> v1::CellTrace {
    let extra = trace.extra.iter().map(|extra| v1::ExtraTrace {
        segment: extra.segment.id.0,
        v0: encode_point(extra.segment.v0),
        v1: encode_point(extra.segment.v1),
        rows: extra.rows,
        trace: Some(encode_segment(&extra.trace)),
    });
    let batches = trace.batches.iter().map(|&(seed, batches)| v1::Batches { seed, batches });
    let viewpoints = trace.viewpoints.iter().map(|&(at, seed, rays)| v1::Viewpoint {
        at: encode_point(at),
        seed,
        rays,
    });
    v1::CellTrace {
        cell: cell.0,
        extra: extra.collect(),
        batches: batches.collect(),
        viewpoints: viewpoints.collect(),
        missing: Some(encode_set(&trace.missing)),
    }
}

fn decode_cell(read: &v1::CellTrace) -> Result<(CellId, CellTrace), TraceError> {
    let extra = |extra: &v1::ExtraTrace| {
        let (v0, v1) = (decode_point(extra.v0.as_ref())?, decode_point(extra.v1.as_ref())?);
        let trace = extra.trace.as_ref().ok_or_else(|| damaged("a segment has no trace"))?;
        let segment = ViewSegment { id: SegmentId(extra.segment), v0, v1 };
        Ok(ExtraTrace { segment, rows: extra.rows, trace: decode_segment(trace)? })
    };
    let viewpoint = |v: &v1::Viewpoint| Ok((decode_point(v.at.as_ref())?, v.seed, v.rays));
    let trace = CellTrace {
        extra: read.extra.iter().map(extra).collect::<Result<_, TraceError>>()?,
        batches: read.batches.iter().map(|b| (b.seed, b.batches)).collect(),
        viewpoints: read.viewpoints.iter().map(viewpoint).collect::<Result<_, TraceError>>()?,
        missing: decode_set(read.missing.as_ref())?,
    };
    Ok((CellId(read.cell), trace))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn set() -> impl Strategy<Value = PrimitiveSet> {
        proptest::collection::btree_set(0u32..500, 0..40).prop_map(PrimitiveSet::from_sorted)
    }

    fn segment_trace() -> impl Strategy<Value = SegmentTrace> {
        let pass = proptest::collection::btree_set(0u32..u32::MAX, 0..9)
            .prop_map(|tiles| tiles.into_iter().collect::<Vec<u32>>());
        (proptest::collection::vec(pass, 0..4), set())
            .prop_map(|(tiles, grazed)| SegmentTrace { tiles, grazed })
    }

    fn cell_trace() -> impl Strategy<Value = CellTrace> {
        let point = || (-1e6..1e6, -1e6..1e6, -1e6..1e6).prop_map(|(x, y, z)| DVec3::new(x, y, z));
        let extra = (any::<u32>(), point(), point(), any::<u32>(), segment_trace()).prop_map(
            |(id, v0, v1, rows, trace)| {
                let segment = ViewSegment { id: SegmentId(id), v0, v1 };
                ExtraTrace { segment, rows, trace }
            },
        );
        let batches = proptest::collection::vec((any::<u64>(), any::<u32>()), 0..4);
        let viewpoints = proptest::collection::vec((point(), any::<u64>(), any::<u32>()), 0..4);
        (proptest::collection::vec(extra, 0..3), batches, viewpoints, set()).prop_map(
            |(extra, batches, viewpoints, missing)| CellTrace {
                extra,
                batches,
                viewpoints,
                missing,
            },
        )
    }

    proptest! {
        #[test]
        fn traces_are_read_as_they_were_written(
            segments in proptest::collection::btree_map(any::<u32>(), segment_trace(), 0..4),
            cells in proptest::collection::btree_map(any::<u32>(), cell_trace(), 0..3),
        ) {
            let segments = segments.into_iter().map(|(id, t)| (SegmentId(id), t)).collect();
            let cells = cells.into_iter().map(|(id, t)| (CellId(id), t)).collect();
            let traces = Traces { segments, cells };
            prop_assert_eq!(Traces::decode(traces.encode()).unwrap(), traces);
        }

        #[test]
        fn bytes_that_are_no_traces_are_refused_or_read(
            bytes in proptest::collection::vec(any::<u8>(), 0..200),
        ) {
            // What is read can be written.
            if let Ok(traces) = Traces::decode(bytes.into()) {
                let _ = traces.encode();
            }
        }
    }
}
