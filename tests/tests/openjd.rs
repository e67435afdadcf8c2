//! The Open Job Description template of k8s/openjd, run by the reference runner on the small city.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

use sightline_tests::binaries::executable;
use sightline_tests::city::{City, LIMIT};
use sightline_tests::process::{self, Process};
use sightline_tests::{dataset, requirement, workspace};

/// The street of the shared bake as a configuration file.
const STREET: &str = "\
    [region]\nrectangles = [[-5.0, -10.0, 5.0, 10.0]]\ncell_size = 5.0\neye_height = [1.5, 1.8]\n\
    [solver]\nrows = 92\nverticals = false\n\
    [accuracy]\ntarget_error = 0.0001\nworst_error = 0.001\nrounds = 3\n\
    [tasks]\nsegments_per_task = 2\ncells_per_task = 1\n";

/// The city, baked once by `sightline bake`.
static CITY: LazyLock<City> =
    LazyLock::new(|| City::bake(&Path::new(env!("CARGO_TARGET_TMPDIR")).join("openjd")));

fn template() -> PathBuf {
    workspace::root().join("k8s/openjd/bake.template.yaml")
}

fn openjd(test: &str) -> Option<PathBuf> {
    let install = "`.venv` with the packages of tests/openjd/requirements.txt";
    requirement::program(test, requirement::openjd(), install)
}

/// A run of one step of the job.
struct Job {
    openjd: PathBuf,
    folder: PathBuf,
}

impl Job {
    /// A job in an empty folder, with this configuration.
    fn new(openjd: PathBuf, name: &str, config: &str) -> Self {
        let folder = CITY.empty(name);
        std::fs::write(folder.join("bake.toml"), config).expect("a file can be written");
        Self { openjd, folder }
    }

    fn out(&self) -> PathBuf {
        self.folder.join("visible")
    }

    fn step(&self, step: &str) -> Process {
        let mut command = Command::new(&self.openjd);
        command.arg("run").arg(template()).args(["--step", step]);
        let parameters = [
            ("Scene", CITY.scene.clone()),
            ("Config", self.folder.join("bake.toml")),
            ("Out", self.out()),
            ("Sightline", executable("sightline").to_owned()),
        ];
        for (name, value) in parameters {
            command.arg("-p").arg(format!("{name}={}", value.display()));
        }
        command.args(["-p", "Threads=1", "-p", "Helpers=2"]);
        Process::start(&mut command, &self.folder, step)
    }
}

#[test]
fn the_template_is_valid() {
    let Some(openjd) = openjd("the_template_is_valid") else { return };
    let ended = process::run(Command::new(openjd).arg("check").arg(template()), LIMIT);
    let _ = ended.success();
}

#[test]
fn a_bake_on_a_farm_writes_the_bytes_of_bake_with_helpers_beside_it() {
    let test = "a_bake_on_a_farm_writes_the_bytes_of_bake_with_helpers_beside_it";
    let Some(openjd) = openjd(test) else { return };
    let job = Job::new(openjd, "with-helpers", STREET);
    // Helpers may come first: they wait for the bake to say where it is.
    let help = job.step("Help");
    let bake = job.step("Bake");
    let bake = bake.wait(LIMIT).success();
    let _ = help.wait(LIMIT).success();
    dataset::assert_same(&CITY.dataset, &job.out());
    // The runner takes what it knows for messages of the job.
    assert!(bake.stdout.contains("openjd_progress: 100.0"), "{}", bake.stdout);
    assert!(bake.stdout.contains("openjd_status: bake "), "{}", bake.stdout);
    // A farm that comes to the helpers when all is done has nothing to do for them.
    let late = job.step("Help").wait(LIMIT).success();
    assert!(late.stdout.contains("the bake is over"), "{}", late.stdout);
}

#[test]
fn a_wrong_configuration_fails_the_task_with_its_message() {
    let Some(openjd) = openjd("a_wrong_configuration_fails_the_task_with_its_message") else {
        return;
    };
    let job = Job::new(openjd, "wrong", &STREET.replace("rows = 92", "row = 92"));
    let ended = job.step("Bake").wait(LIMIT);
    assert!(!ended.status.success(), "{ended:#?}");
    let message = ended.stdout.lines().find(|line| line.contains("openjd_fail: "));
    let message = message.unwrap_or_else(|| panic!("no message: {ended:#?}"));
    assert!(message.contains("did you mean `solver.rows`"), "{message}");
    assert!(!job.out().join("current.json").exists());
}
