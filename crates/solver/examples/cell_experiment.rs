//! scratch
use glam::DVec3;
use sightline_geometry::*;
use sightline_quality::*;
use sightline_scene::{region::*, *};
use sightline_solver::*;
use std::time::Instant;
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let t = Instant::now();
    let mut o = OpenOptions::default();
    o.see_through = vec![];
    let scene = Scene::open(a[1].as_ref(), &o).unwrap();
    let f = |k: usize| a[k].parse::<f64>().unwrap();
    println!("open {:?} prims {} unique {} instances {} bounds {:?}", t.elapsed(), scene.geometry.primitive_count(), scene.geometry.unique_triangle_count(), scene.geometry.instances.len(), scene.geometry.bounds);
    let spec = RegionSpec { rectangles: vec![[f(2), f(3), f(4), f(5)]], polygons: vec![], cell_size: f(6), eye_height: [f(7), f(8)],
        heights: if a[9] == "abs" { Heights::Absolute } else { Heights::AboveGround { from: a.get(13).map(|v| v.parse().unwrap()), ground: vec![a[9].clone()] } } };
    let t = Instant::now();
    let r = tile(&scene, &spec).unwrap();
    println!("tile {:?}: {} cells, skipped {:?}", t.elapsed(), r.cells.len(), r.skipped);
    let rows: u32 = a[10].parse().unwrap();
    let rings: u32 = a[11].parse().unwrap();
    let max_cells: usize = a[12].parse().unwrap();
    let sampling = Sampling::new(rows);
    let step = (r.cells.len() / max_cells).max(1);
    let (mut solve, mut meas) = (0.0, 0.0);
    let (mut n, mut segs) = (0, 0);
    let (mut sum, mut worst): (f64, f64) = (0.0, 0.0);
    let mut hist = [0; 6];
    let mut worsts = vec![];
    for (cell, _) in r.cells.iter().step_by(step) {
        let t = Instant::now();
        let mut sets = vec![];
        let mut st = [0u64; 5];
        for k in 0..rings {
            let h = if rings == 1 { 0.5 } else { k as f64 / (rings - 1) as f64 } * cell.height;
            for e in 0..4 {
                let s = ViewSegment { id: SegmentId(0), v0: cell.corners[e] + DVec3::Y * h, v1: cell.corners[(e + 1) % 4] + DVec3::Y * h };
                let v = solve_segment(&scene.geometry, &s, sampling);
                let c = v.statistics;
                for (a, b) in st.iter_mut().zip([c.nodes, c.triangles, c.cuts, c.pixel_tests, c.intervals]) { *a += b; }
                sets.push(v.set);
                segs += 1;
            }
        }
        let contact = overlap::primitives_in_cell(&scene.geometry, cell);
        let set = PrimitiveSet::union(sets.iter().chain([&contact]));
        solve += t.elapsed().as_secs_f64();
        let t = Instant::now();
        let e = measure_cell(&scene.geometry, &set, cell, 10, std::env::var("RAYS").map_or(100000, |r| r.parse().unwrap()), 1);
        meas += t.elapsed().as_secs_f64();
        n += 1;
        sum += e.mean();
        worst = worst.max(e.max());
        for v in &e.viewpoints { let k = if v.error > 0.005 { 5 } else if v.error > 0.002 { 4 } else if v.error > 0.001 { 3 } else if v.error > 0.0002 { 2 } else if v.error > 0.0 { 1 } else { 0 }; hist[k] += 1;
            if v.error > 0.002 { worsts.push((v.error, cell.id, v.viewpoint)); } }
        if n <= 2 { println!("cell {} set {} contact {} per segment nodes {} tris {} cuts {} tests {} ivals {}", cell.id, set.len(), contact.len(), st[0] / 4 / rings as u64, st[1] / 4 / rings as u64, st[2] / 4 / rings as u64, st[3] / 4 / rings as u64, st[4] / 4 / rings as u64); }
    }
    println!("{n} cells, {segs} segs: solve {:.3}s = {:.3} s/seg; measure {:.2}s = {:.2} Mrays/s; mean {:.5}% worst {:.4}% hist(0,<.02,<.1,<.2,<.5,more) {hist:?}", solve, solve / segs as f64, meas, n as f64 / meas, 100.0 * sum / n as f64, 100.0 * worst);
    worsts.sort_by(|a, b| b.0.total_cmp(&a.0));
    for w in worsts.iter().take(12) { println!("  {:.3}% {:?} {:?}", 100.0 * w.0, w.1, w.2); }
}
