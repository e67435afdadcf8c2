#![allow(missing_docs, clippy::print_stdout)]
fn main() {
    for p in std::env::args().skip(1) {
        let mut o = sightline_scene::OpenOptions::default();
        if let Ok(n) = std::env::var("ANIM") {
            o.animation = if n == "all" {
                sightline_scene::AnimationChoice::All
            } else {
                sightline_scene::AnimationChoice::Index(n.parse().unwrap())
            };
        }
        let t = std::time::Instant::now();
        match sightline_scene::Scene::open(std::path::Path::new(&p), &o) {
            Ok(s) => {
                s.assert_well_formed();
                let r = &s.report;
                println!(
                    "{p}: {:.2?} states {} dur {:.3} moving obj {}/{} tris {}/{} jumps {} taken {:?} ignored {:?} warn {:?} bounds {:?}",
                    t.elapsed(),
                    r.states,
                    r.duration_s,
                    r.moving_objects,
                    r.objects,
                    r.moving_triangles,
                    r.instanced_triangles,
                    r.jumps,
                    r.animations_taken,
                    r.ignored_channels,
                    r.warnings,
                    s.geometry.bounds.size()
                )
            }
            Err(e) => println!("{p}: ERR {e}"),
        }
    }
}
