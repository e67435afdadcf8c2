//! scratch
use glam::DVec3;
use rayon::prelude::*;
use sightline_geometry::raycast::*;
use sightline_geometry::*;
use sightline_scene::generate::*;
use sightline_scene::particles::*;
use sightline_scene::*;
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let n: u64 = a[1].parse().unwrap();
    let eye: f64 = a[2].parse().unwrap();
    let views: u64 = a[3].parse().unwrap();
    let t = std::time::Instant::now();
    let p = std::env::temp_dir().join("particles_scratch.parquet");
    let mut f = std::io::BufWriter::new(std::fs::File::create(&p).unwrap());
    let r = bouncing_spheres(n, 25, 1, TableFormat::Parquet, &mut f).unwrap();
    drop(f);
    println!("gen {:?} {:?}", t.elapsed(), r);
    let t = std::time::Instant::now();
    let s = Scene::open(&p, &OpenOptions::default()).unwrap();
    println!("open {:?}", t.elapsed());
    println!(
        "{}",
        std::fs::read_to_string("/proc/self/status")
            .unwrap()
            .lines()
            .filter(|l| l.starts_with("VmHWM"))
            .collect::<String>()
    );
    let g = &s.geometry;
    let h = |mut z: u64| {
        z = z.wrapping_mul(0x9e3779b97f4a7c15);
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58476d1ce4e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d049bb133111eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    };
    let seen: Vec<Vec<u32>> = (0..views)
        .into_par_iter()
        .map_init(RayCaster::new, |c, v| {
            let mut out = vec![];
            let o = DVec3::new(20. * h(v * 7 + 1) - 10., eye, 20. * h(v * 7 + 2) - 10.);
            let m = Moment { state: (v % 25) as u32, t: h(v * 7 + 3) };
            for k in 0..20000u64 {
                let u = 2. * h(v * 100003 + 2 * k + 500) - 1.;
                let ph = std::f64::consts::TAU * h(v * 100003 + 2 * k + 501);
                let q = (1. - u * u).sqrt();
                let mut ray = Ray::new(o, DVec3::new(q * ph.cos(), u, q * ph.sin()));
                ray.moment = m;
                if ray.direction.y < 0. {}
                if let Some(x) = c.closest_occluder(g, ray, 1e9, |_| true) {
                    let hp = o.y + x.distance * ray.direction.y;
                    if hp >= 0. {
                        out.push(x.primitive.0)
                    }
                }
            }
            out.sort();
            out.dedup();
            out
        })
        .collect();
    for lim in [views / 4, views / 2, views] {
        let mut a: Vec<u32> = seen[..lim as usize].iter().flatten().copied().collect();
        a.sort();
        a.dedup();
        println!("{lim} views: {}", a.len());
    }
    println!("mean per view {}", seen.iter().map(|v| v.len()).sum::<usize>() / seen.len());
}
