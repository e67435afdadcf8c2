//! `sightline generate`: a benchmark scene as glTF, or as a particle table.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use serde_json::json;
use sightline_scene::generate::{self, GenerateError, GenerateReport, Kind as Generated};
use sightline_scene::particles::TableFormat;

use crate::arguments::{Generate, SceneKind};
use crate::failure::{Failure, Kind, Result};
use crate::memory::Phases;
use crate::report::{Table, bytes, print, print_json, thousands};

/// Triangles, spheres and states when their flags are absent; the sizes of the source's smaller
/// datasets.
const TRIANGLES: u64 = 200_000;
const SPHERES: u64 = 10_000;
const SPHERE_STATES: u32 = 25;
const GRASS_STATES: u32 = 10;
const SPHERES_NAME: &str = "bouncing-spheres";

pub fn run(command: &Generate) -> Result<()> {
    let recipe = Recipe::of(command)?;
    let mut phases = Phases::start("generate");
    let made = match recipe {
        Recipe::Triangles(kind, triangles) => write(kind, triangles, command.seed, &command.out)?,
        Recipe::Spheres(count, states, format) => write_file(&command.out, |file| {
            generate::bouncing_spheres(count, states, command.seed, format, file)
        })?,
    };
    phases.finish();
    let region = flag_value(&made.suggested_region);
    let eyes = flag_value(&made.suggested_eye_height);
    if command.json {
        print_json(&json!({
            "scene": command.out,
            "kind": recipe.name(),
            "seed": command.seed,
            "triangles": made.triangles,
            "unique_triangles": made.unique_triangles,
            "particles": made.particles,
            "states": made.states,
            "bytes": made.bytes,
            "bounds": { "min": made.bounds.min, "max": made.bounds.max },
            "suggested_region": made.suggested_region,
            "suggested_eye_height": made.suggested_eye_height,
            "time": phases.to_json(),
        }));
        return Ok(());
    }
    // Nothing of a table of spheres is ground to measure heights from.
    let heights = if made.triangles == 0 { " --heights absolute" } else { "" };
    let mut table = Table::default();
    table.row("scene", command.out.display().to_string());
    if made.triangles > 0 {
        table
            .row("triangles", thousands(made.triangles))
            .row("unique triangles", thousands(made.unique_triangles));
    }
    if made.particles > 0 {
        table.row("spheres", thousands(made.particles));
    }
    if made.states > 1 {
        table.row("states", thousands(made.states.into()));
    }
    table.row("size", bytes(made.bytes));
    phases.add_to(&mut table);
    print(&format!(
        "{table}\nTo bake it:\n  sightline bake {} --out visible --region={region} --eye-height {eyes}{heights}\n",
        super::quoted(&command.out.display().to_string()),
    ));
    Ok(())
}

/// Refuses a flag that was given to a kind that does not have it.
fn refuse(flag: &str, given: bool, kind: &str, kinds: &str) -> Result<()> {
    if !given {
        return Ok(());
    }
    Err(Failure::new(Kind::Usage, format!("{flag} does not apply to {kind}"))
        .with_help(format!("{flag} is for {kinds}")))
}

/// What to generate, with its sizes.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Recipe {
    /// A kind of glTF scene and its triangles.
    Triangles(Generated, u64),
    /// Bouncing spheres: how many, over how many states, in which format.
    Spheres(u64, u32, TableFormat),
}

impl Recipe {
    /// Takes the flags of the kind, and refuses those of others.
    fn of(command: &Generate) -> Result<Self> {
        let kind = match command.kind {
            SceneKind::City => Generated::City,
            SceneKind::Town => Generated::Town,
            SceneKind::Grass => Generated::Grass,
            SceneKind::SwayingGrass => {
                Generated::SwayingGrass { states: command.states.unwrap_or(GRASS_STATES) }
            }
            SceneKind::BouncingSpheres => return Self::spheres(command),
        };
        refuse("--count", command.count.is_some(), kind.name(), "bouncing-spheres")?;
        let states = command.states.is_some() && !matches!(kind, Generated::SwayingGrass { .. });
        refuse("--states", states, kind.name(), "bouncing-spheres and swaying-grass")?;
        if TableFormat::of(&command.out).is_some() {
            let text = format!("`{}` names a table of particles", command.out.display());
            return Err(Failure::new(Kind::Usage, text)
                .with_help("give --out a name that ends in .glb for a scene of triangles"));
        }
        Ok(Self::Triangles(kind, command.triangles.unwrap_or(TRIANGLES)))
    }

    fn spheres(command: &Generate) -> Result<Self> {
        refuse("--triangles", command.triangles.is_some(), SPHERES_NAME, "the other kinds")?;
        let format = TableFormat::of(&command.out).ok_or_else(|| {
            let text = format!("`{}` names no table", command.out.display());
            Failure::new(Kind::Usage, text).with_help(
                "bouncing-spheres is a table of particles: give --out a name that ends in .parquet \
                 or .csv",
            )
        })?;
        let states = command.states.unwrap_or(SPHERE_STATES);
        Ok(Self::Spheres(command.count.unwrap_or(SPHERES), states, format))
    }

    fn name(self) -> &'static str {
        match self {
            Self::Triangles(kind, _) => kind.name(),
            Self::Spheres(..) => SPHERES_NAME,
        }
    }
}

/// Generates a scene of triangles into a file, which appears when it is complete.
pub fn write(kind: Generated, triangles: u64, seed: u64, out: &Path) -> Result<GenerateReport> {
    write_file(out, |file| generate::generate(kind, triangles, seed, file))
}

/// Generates a scene into a file, which appears when it is complete.
fn write_file(
    out: &Path,
    generate: impl FnOnce(&mut BufWriter<File>) -> std::result::Result<GenerateReport, GenerateError>,
) -> Result<GenerateReport> {
    let failed = |what, path: &Path, e: &std::io::Error| {
        Failure::io(Kind::Store, what, path, e)
            .with_help("check that the folder exists, its rights and its free space")
    };
    super::write_whole(out, |partial| {
        let file = File::create(partial).map_err(|e| failed("write", partial, &e))?;
        let mut file = BufWriter::new(file);
        let report = generate(&mut file)?;
        let file = file.into_inner().map_err(|e| failed("write", partial, e.error()))?;
        file.sync_all().map_err(|e| failed("write", partial, &e))?;
        Ok(report)
    })
}

/// Numbers as a flag takes them.
fn flag_value(numbers: &[f64]) -> String {
    let numbers: Vec<String> = numbers.iter().map(f64::to_string).collect();
    numbers.join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recipe(kind: SceneKind, change: impl FnOnce(&mut Generate)) -> Result<Recipe> {
        let mut command = Generate {
            kind,
            triangles: None,
            count: None,
            states: None,
            seed: 1,
            out: "a.glb".into(),
            json: false,
        };
        change(&mut command);
        Recipe::of(&command)
    }

    #[test]
    fn every_kind_takes_its_own_flags_alone() {
        use SceneKind::{BouncingSpheres, City, SwayingGrass};
        let sway = recipe(SwayingGrass, |c| c.states = Some(3)).unwrap();
        assert_eq!(sway, Recipe::Triangles(Generated::SwayingGrass { states: 3 }, TRIANGLES));
        let spheres = recipe(BouncingSpheres, |c| c.out = "a.csv".into()).unwrap();
        assert_eq!(spheres, Recipe::Spheres(SPHERES, SPHERE_STATES, TableFormat::Csv));
        assert!(recipe(City, |c| c.triangles = Some(5)).is_ok());
        assert!(recipe(City, |c| c.states = Some(5)).is_err());
        assert!(recipe(City, |c| c.count = Some(5)).is_err());
        assert!(recipe(City, |c| c.out = "a.parquet".into()).is_err());
        assert!(recipe(BouncingSpheres, |_| ()).is_err(), "a table is no .glb");
        let triangles = recipe(BouncingSpheres, |c| {
            (c.triangles, c.out) = (Some(5), "a.parquet".into());
        });
        assert!(triangles.is_err());
    }
}
