//! The command line: commands, flags and their help texts.
//!
//! The flags of the configuration are made from [`sightline_jobs::KEYS`], so that `--help`
//! documents every key and no flag can be missing.

use std::path::PathBuf;

use bytesize::ByteSize;
use clap::{ArgAction, ArgMatches, Args, Command, FromArgMatches, Parser, Subcommand, ValueEnum};
use sightline_coordinator::{SecurityFlags, ShareScene};
use sightline_geometry::CellId;
use sightline_jobs::{KEYS, KeyDoc};
use sightline_scene::{MemoryLimit, default_folder};
use sightline_store::CACHE_BYTES_MAX;
use sightline_telemetry::{LogFormat, WatchFlags};
use sightline_worker::ClientSecurity;

/// Precomputed visibility for large 3D worlds: which triangles can be seen from where.
#[derive(Debug, Parser)]
#[command(name = "sightline", version, after_long_help = crate::failure::exit_codes_help())]
#[command(arg_required_else_help = true, subcommand_required = true)]
pub struct Arguments {
    /// What to do.
    #[command(subcommand)]
    pub command: Task,

    /// Say more: -v for notes of every part, -vv for details. RUST_LOG overrules it.
    #[arg(short, long, global = true, action = ArgAction::Count, conflicts_with = "quiet")]
    pub verbose: u8,

    /// No progress and no notes, only results and errors.
    #[arg(short, long, global = true)]
    pub quiet: bool,

    /// How progress is written: for people, or as messages of Open Job Description on stdout.
    #[arg(long, global = true, value_enum, default_value = "auto", value_name = "STYLE")]
    pub progress: crate::progress::Style,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Task {
    /// Write a deterministic benchmark scene as glTF, or as a particle table.
    Generate(Generate),
    /// Bake the visible sets of a scene into a dataset, on this machine.
    Bake(Box<Bake>),
    /// Run the coordinator of a distributed bake.
    Coordinator(Box<Coordinator>),
    /// Work for a coordinator until its bake is done.
    Worker(Worker),
    /// Show how a bake is doing, or what is stored of it.
    Status(Box<Status>),
    /// Measure the pixel error of a dataset by casting rays through the full scene.
    Verify(Verify),
    /// Write what is visible from one cell as glTF.
    Export(Export),
    /// Describe a scene, a dataset or a cell.
    Info(Info),
    /// Find the cell of a position, and what matters most in it.
    Cell(Cell),
    /// Generate a city, bake it, verify it, and show where to look next.
    Demo(Demo),
    /// Manifests for Kubernetes.
    K8s(crate::commands::K8s),
}

impl Task {
    /// How log lines look.
    pub fn log_format(&self) -> LogFormat {
        match self {
            Self::Coordinator(c) => c.watch.log_format,
            Self::Worker(c) => c.watch.log_format,
            _ => LogFormat::Text,
        }
    }

    /// Name of the process in traces.
    pub const fn service(&self) -> &'static str {
        match self {
            Self::Coordinator(_) => "sightline-coordinator",
            Self::Worker(_) => "sightline-worker",
            _ => "sightline",
        }
    }

    /// True when the result is wanted as JSON.
    pub fn wants_json(&self) -> bool {
        match self {
            Self::Generate(c) => c.json,
            Self::Bake(c) => c.json,
            Self::Verify(c) => c.json,
            Self::Export(c) => c.json,
            Self::Info(c) => c.json,
            Self::Cell(c) => c.json,
            Self::Status(c) => c.json,
            Self::Coordinator(_) | Self::Worker(_) | Self::Demo(_) | Self::K8s(_) => false,
        }
    }
}

/// Kinds of benchmark scenes.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum SceneKind {
    /// Blocks of tall buildings with detailed facades on a grid of streets.
    City,
    /// Small gabled houses along crooked streets, with trees.
    Town,
    /// A meadow of instanced grass and flowers.
    Grass,
    /// The same meadow in the wind: every blade moves.
    SwayingGrass,
    /// Spheres that bounce on the ground until they rest, as a Parquet or CSV table.
    BouncingSpheres,
}

/// `generate`.
#[derive(Debug, Args)]
pub struct Generate {
    /// What to generate.
    pub kind: SceneKind,
    /// Triangles, instances counted: within 2 % of it. `200k` and `3.7M` are understood; 200k when
    /// absent. Not for bouncing-spheres.
    #[arg(long, value_name = "N", value_parser = parse_count)]
    pub triangles: Option<u64>,
    /// Spheres of bouncing-spheres; 10k when absent.
    #[arg(long, value_name = "N", value_parser = parse_count)]
    pub count: Option<u64>,
    /// States of bouncing-spheres and swaying-grass: stretches of linear motion between two key
    /// frames; 25 and 10 when absent.
    #[arg(long, value_name = "K")]
    pub states: Option<u32>,
    /// Scenes of the same kind, size and seed are the same, byte for byte.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// The file to write: SCENE.glb, or SCENE.parquet or SCENE.csv for bouncing-spheres.
    #[arg(short, long, value_name = "SCENE")]
    pub out: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

/// Where copies of scene files from object stores are kept.
#[derive(Clone, Debug, Args)]
pub struct CacheFlags {
    /// Folder for copies of scene files from object stores; any number of processes may share it. In
    /// the system's folder for caches when absent.
    #[arg(long, value_name = "DIR", env = "SIGHTLINE_CACHE")]
    pub cache: Option<PathBuf>,
    /// Limit of that folder, such as 20GiB or 500MB. What was not used for longest is removed first.
    #[arg(long, value_name = "SIZE", default_value = "20GiB", env = "SIGHTLINE_CACHE_SIZE")]
    pub cache_size: ByteSize,
}

impl Default for CacheFlags {
    fn default() -> Self {
        Self { cache: None, cache_size: ByteSize(CACHE_BYTES_MAX) }
    }
}

/// How much memory the process may take.
#[derive(Clone, Debug, Default, Args)]
pub struct MemoryFlags {
    /// Most memory that the process takes, such as 4GiB or 800MiB: triangles are then read from a file of
    /// chunks, made beside others in --chunks the first time, and only what is not hidden is loaded.
    /// The result is the same. Everything is in memory when absent.
    #[arg(long, value_name = "SIZE", env = "SIGHTLINE_MEMORY")]
    pub memory: Option<ByteSize>,
    /// Folder of the chunk files; `sightline` in the user's cache folder when absent.
    #[arg(long, value_name = "DIR", env = "SIGHTLINE_CHUNKS", requires = "memory")]
    pub chunks: Option<PathBuf>,
}

impl MemoryFlags {
    /// The limit that they ask for.
    pub fn limit(&self) -> Option<MemoryLimit> {
        let folder = || self.chunks.clone().unwrap_or_else(default_folder);
        self.memory.map(|size| MemoryLimit::new(size.0, folder()))
    }
}

/// Scene, output and configuration of a bake.
#[derive(Debug, Args)]
pub struct BakeInput {
    /// The scene: a .gltf or .glb file or a particle table, or its URL in an object store.
    pub scene: PathBuf,
    /// Folder of the dataset, or its URL in an object store, such as s3://bucket/prefix; made when it
    /// does not exist. Holds the state of the bake too. Credentials come from the environment.
    #[arg(short, long, value_name = "DIR|URL")]
    pub out: String,
    /// Configuration file (TOML). Flags below overrule its keys.
    #[arg(short, long, value_name = "bake.toml")]
    pub config: Option<PathBuf>,
    /// Copies of the scene, when it comes from an object store.
    #[command(flatten)]
    pub cache: CacheFlags,
    /// How much memory it may take.
    #[command(flatten)]
    pub memory: MemoryFlags,
    /// One flag a key of the configuration.
    #[command(flatten)]
    pub keys: ConfigFlags,
}

/// `bake`.
#[derive(Debug, Args)]
#[command(
    after_long_help = "Example:\n  sightline bake city.glb --out visible --region=-50,-50,50,50\n\n\
    Ctrl-C keeps what is done: the same command resumes the bake."
)]
pub struct Bake {
    /// What to bake.
    #[command(flatten)]
    pub input: BakeInput,
    /// Threads; all cores when absent.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Whether others may help.
    #[command(flatten)]
    pub joining: crate::commands::Joining,
    /// Print the plan and stop.
    #[arg(long)]
    pub dry_run: bool,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

/// `coordinator`.
#[derive(Debug, Args)]
pub struct Coordinator {
    /// What to bake.
    #[command(flatten)]
    pub input: BakeInput,
    /// Address and port to listen on.
    #[arg(long, default_value = "127.0.0.1:7070", value_name = "HOST:PORT")]
    pub listen: std::net::SocketAddr,
    /// Put copies of the scene's files into the store, for workers that do not see this machine's disk:
    /// always, never, or when the store is an object store (auto).
    #[arg(long, value_name = "WHEN", default_value = "auto")]
    pub share_scene: ShareScene,
    /// Who may talk to it.
    #[command(flatten)]
    pub security: SecurityFlags,
    /// Answer health checks there in plain text, and nothing else: for probes, which have no
    /// certificates.
    #[arg(long, value_name = "HOST:PORT", env = "SIGHTLINE_HEALTH")]
    pub health: Option<std::net::SocketAddr>,
    /// How it can be watched.
    #[command(flatten)]
    pub watch: WatchFlags,
}

/// `worker`.
#[derive(Debug, Args)]
pub struct Worker {
    /// The coordinator, such as http://127.0.0.1:7070, or @FILE: a bake's --announce.
    #[arg(long, value_name = "URL")]
    pub coordinator: String,
    /// The scene on this machine or its URL, when it is elsewhere than on the coordinator's. Where it is
    /// not found, it is fetched from the store.
    #[arg(long, value_name = "PATH|URL")]
    pub scene: Option<PathBuf>,
    /// Fetch the scene from the store even when it is found.
    #[arg(long)]
    pub fetch_scene: bool,
    /// The dataset folder on this machine or its URL, when it is elsewhere than on the coordinator's.
    #[arg(long, value_name = "DIR|URL")]
    pub out: Option<String>,
    /// Copies of a scene that is fetched.
    #[command(flatten)]
    pub cache: CacheFlags,
    /// How much memory it may take.
    #[command(flatten)]
    pub memory: MemoryFlags,
    /// Threads; all cores when absent.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Answer gRPC health checks here, without encryption, for the probes of a platform.
    #[arg(long, value_name = "HOST:PORT", env = "SIGHTLINE_HEALTH")]
    pub health: Option<std::net::SocketAddr>,
    /// How long the task at hand may still take when the worker is asked to stop (Ctrl-C, SIGTERM), s.
    /// Below the time that a platform gives a process to end.
    #[arg(long, value_name = "SECONDS", default_value_t = 20, env = "SIGHTLINE_DRAIN_SECONDS")]
    pub drain_seconds: u64,
    /// A name for people, in statuses and logs; need not be unique. The process number when absent.
    #[arg(long, value_name = "NAME", env = "SIGHTLINE_NAME")]
    pub name: Option<String>,
    /// Credentials.
    #[command(flatten)]
    pub security: ClientSecurity,
    /// How it can be watched.
    #[command(flatten)]
    pub watch: WatchFlags,
}

/// `status`.
#[derive(Debug, Args)]
pub struct Status {
    /// URL of a coordinator, such as http://127.0.0.1:7070; or the location of a dataset, to see
    /// what is stored.
    #[arg(value_name = "URL|DATASET")]
    pub of: String,
    /// Show it once and end, on a terminal too.
    #[arg(long, conflicts_with = "watch")]
    pub once: bool,
    /// Show it at every change until the bake ends; so it does on a terminal.
    #[arg(long)]
    pub watch: bool,
    /// Print one JSON object, with --watch one a line.
    #[arg(long)]
    pub json: bool,
    /// Credentials.
    #[command(flatten)]
    pub security: ClientSecurity,
}

/// A dataset and its scene.
#[derive(Debug, Args)]
pub struct DatasetInput {
    /// Folder of the dataset, or its URL in an object store.
    pub dataset: String,
    /// The scene that was baked or its URL; looked for where it was baked from, beside the dataset and
    /// in the dataset's store when absent.
    #[arg(long, value_name = "PATH|URL")]
    pub scene: Option<PathBuf>,
    /// Copies of the scene, when it comes from an object store.
    #[command(flatten)]
    pub cache: CacheFlags,
    /// How much memory it may take.
    #[command(flatten)]
    pub memory: MemoryFlags,
}

/// `verify`.
#[derive(Debug, Args)]
#[command(after_long_help = "The pixel error of a viewpoint is the share of all directions in \
    which the visible set of the cell shows something farther than the full scene does. Exit \
    code 1: a limit is exceeded.")]
pub struct Verify {
    /// What to verify.
    #[command(flatten)]
    pub input: DatasetInput,
    /// Random viewpoints a cell.
    #[arg(long, default_value_t = 10, value_name = "N")]
    pub viewpoints: u32,
    /// Rays a viewpoint, over the whole sphere.
    #[arg(long, default_value = "100000", value_name = "N", value_parser = parse_rays)]
    pub rays: u32,
    /// `all`, or the number of cells to measure, evenly spread over the dataset.
    #[arg(long, default_value = "all", value_name = "all|N", conflicts_with = "cell")]
    pub cells: CellChoice,
    /// Measure this cell only.
    #[arg(long, value_name = "ID", value_parser = parse_cell)]
    pub cell: Option<CellId>,
    /// Measure this viewpoint only; --seed is then the seed of its directions.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, allow_hyphen_values = true)]
    #[arg(requires = "cell", conflicts_with = "viewpoints")]
    pub viewpoint: Option<glam::DVec3>,
    /// When that viewpoint is looked at: a state, and how far it has gone, from 0 to 1.
    #[arg(long, value_name = "STATE,T", value_parser = parse_moment, requires = "viewpoint")]
    pub moment: Option<sightline_geometry::Moment>,
    /// Seed of viewpoints and directions.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Fail when the mean error over all viewpoints is larger (share of pixels, 0.0002 is 0.02 %).
    #[arg(long, value_name = "E")]
    pub max_mean: Option<f64>,
    /// Fail when the error of the worst viewpoint is larger (share of pixels).
    #[arg(long, value_name = "E")]
    pub max_worst: Option<f64>,
    /// Threads; all cores when absent.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

/// Which cells to verify.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CellChoice {
    /// Every cell.
    All,
    /// So many, evenly spread.
    Spread(u32),
}

impl std::str::FromStr for CellChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "all" => Ok(Self::All),
            _ => match text.parse() {
                Ok(n) if n > 0 => Ok(Self::Spread(n)),
                _ => Err("give `all` or a number of cells".into()),
            },
        }
    }
}

/// `export`.
#[derive(Debug, Args)]
pub struct Export {
    /// What to export from.
    #[command(flatten)]
    pub input: DatasetInput,
    /// The cell.
    #[arg(long, value_name = "ID", value_parser = parse_cell)]
    pub cell: CellId,
    /// Write what is seen in this state of a moving scene, as it stands at the state's key frame;
    /// otherwise what is seen in any state, as at the first.
    #[arg(long, value_name = "N", conflicts_with = "time")]
    pub state: Option<u32>,
    /// Write what is seen in the state at this time, as it stands then; in seconds.
    #[arg(long, value_name = "SECONDS", allow_hyphen_values = true)]
    pub time: Option<f64>,
    /// Write only the so many most important primitives.
    #[arg(long, value_name = "N", value_parser = parse_count)]
    pub budget: Option<u64>,
    /// The file to write.
    #[arg(short, long, value_name = "CELL.glb")]
    pub out: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

/// `info`.
#[derive(Debug, Args)]
pub struct Info {
    /// A scene file or the folder of a dataset, or the URL of one.
    pub path: PathBuf,
    /// Copies of the scene, when it comes from an object store.
    #[command(flatten)]
    pub cache: CacheFlags,
    /// Describe this cell of the dataset.
    #[arg(long, value_name = "ID", value_parser = parse_cell)]
    pub cell: Option<CellId>,
    /// List at most so many objects and degenerate triangles; JSON lists all objects.
    #[arg(long, default_value_t = 20, value_name = "N")]
    pub limit: usize,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

/// `cell`.
#[derive(Debug, Args)]
pub struct Cell {
    /// Folder of the dataset, or its URL in an object store.
    pub dataset: String,
    /// The position, world space, metres.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, allow_hyphen_values = true)]
    #[arg(required_unless_present = "cell", conflicts_with = "cell")]
    pub at: Option<glam::DVec3>,
    /// The cell, when its number is known.
    #[arg(long, value_name = "ID", value_parser = parse_cell)]
    pub cell: Option<CellId>,
    /// List the so many most important triangles of the cell, each with its share of the view, the
    /// most important first.
    #[arg(long, value_name = "N", value_parser = parse_count)]
    pub budget: Option<u64>,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

/// `demo`.
#[derive(Debug, Args)]
pub struct Demo {
    /// Folder for the scene, the dataset and the exported cell.
    #[arg(short, long, default_value = "sightline-demo", value_name = "DIR")]
    pub out: PathBuf,
    /// Triangles of the city.
    #[arg(long, default_value = "200k", value_name = "N", value_parser = parse_count)]
    pub triangles: u64,
    /// Threads; all cores when absent.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
}

/// Values of configuration keys that were given as flags, in TOML form.
#[derive(Clone, Debug, Default)]
pub struct ConfigFlags {
    /// Key and value.
    pub overrides: Vec<(&'static str, String)>,
}

/// How the flag of a key takes its value.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Shape {
    /// One TOML value as it is.
    Plain,
    /// One text, whatever it looks like.
    Text,
    /// Repeatable files.
    Files,
    /// Repeatable patterns.
    Patterns,
    /// Repeatable rectangles.
    Rectangles,
    /// Repeatable polygons.
    Polygons,
    /// Two numbers, or one that stands for both.
    Range,
}

fn shape(key: &KeyDoc) -> Shape {
    match key.kind {
        "text or an integer" => Shape::Text,
        "list of paths" => Shape::Files,
        "list of glob patterns" => Shape::Patterns,
        "list of [x0, z0, x1, z1]" => Shape::Rectangles,
        "list of lists of [x, z]" => Shape::Polygons,
        "[lowest, highest]" => Shape::Range,
        _ => Shape::Plain,
    }
}

/// The flag of a key, without its dashes.
fn flag(key: &KeyDoc) -> String {
    match key.key {
        "region.rectangles" => "region".into(),
        "region.polygons" => "polygon".into(),
        full => full.split('.').next_back().unwrap_or(full).replace('_', "-"),
    }
}

fn flag_help(key: &KeyDoc) -> String {
    let mut help = format!("{}\n\nConfiguration key `{}`: {}", key.doc, key.key, key.kind);
    if !key.unit.is_empty() {
        help.push_str(&format!(", {}", key.unit));
    }
    if key.default.is_empty() {
        help.push_str("; absent by default.");
    } else {
        help.push_str(&format!("; default {}.", key.default));
    }
    match shape(key) {
        Shape::Patterns => help.push_str(" Can be repeated; an empty text stands for no pattern."),
        Shape::Rectangles | Shape::Polygons | Shape::Files => help.push_str(" Can be repeated."),
        Shape::Plain | Shape::Text | Shape::Range => {}
    }
    help
}

impl Args for ConfigFlags {
    fn augment_args(mut command: Command) -> Command {
        for key in KEYS {
            let arg = clap::Arg::new(key.key)
                .long(flag(key))
                .help(key.doc)
                .long_help(flag_help(key))
                .help_heading("Configuration")
                .allow_hyphen_values(true);
            let arg = match shape(key) {
                Shape::Plain => arg.value_name("VALUE"),
                Shape::Text => arg.value_name("NAME"),
                Shape::Files => arg.value_name("FILE").action(ArgAction::Append),
                Shape::Patterns => arg.value_name("PATTERN").action(ArgAction::Append),
                Shape::Rectangles => arg
                    .value_name("X0,Z0,X1,Z1")
                    .action(ArgAction::Append)
                    .value_parser(parse_rectangle),
                Shape::Polygons => arg
                    .value_name("X0,Z0,X1,Z1,...")
                    .action(ArgAction::Append)
                    .value_parser(parse_polygon),
                Shape::Range => arg.value_name("LOW,HIGH").value_parser(parse_range),
            };
            command = command.arg(arg);
        }
        command
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for ConfigFlags {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let mut overrides = Vec::new();
        for key in KEYS {
            let Some(values) = matches.get_many::<String>(key.key) else { continue };
            let values: Vec<&str> = values.map(String::as_str).collect();
            overrides.push((key.key, toml_value(shape(key), &values)));
        }
        Ok(Self { overrides })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

/// The TOML form of the values of a flag.
fn toml_value(shape: Shape, values: &[&str]) -> String {
    match shape {
        Shape::Plain | Shape::Range => values.last().copied().unwrap_or_default().to_owned(),
        Shape::Rectangles | Shape::Polygons => format!("[{}]", values.join(", ")),
        Shape::Text => quoted(values.last().copied().unwrap_or_default()),
        Shape::Patterns | Shape::Files => {
            let quoted: Vec<String> =
                values.iter().filter(|v| !v.is_empty()).map(|v| quoted(v)).collect();
            format!("[{}]", quoted.join(", "))
        }
    }
}

/// A JSON string is a TOML string.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

fn numbers(text: &str) -> Result<Vec<f64>, String> {
    text.split(',')
        .map(|part| match part.trim().parse::<f64>() {
            Ok(n) if n.is_finite() => Ok(n),
            _ => Err(format!("`{part}` is not a number")),
        })
        .collect()
}

fn parse_rectangle(text: &str) -> Result<String, String> {
    match numbers(text)?[..] {
        [x0, z0, x1, z1] => Ok(format!("[{x0:?}, {z0:?}, {x1:?}, {z1:?}]")),
        _ => Err("give four numbers: x0,z0,x1,z1 with x0 < x1 and z0 < z1".into()),
    }
}

fn parse_polygon(text: &str) -> Result<String, String> {
    let numbers = numbers(text)?;
    if numbers.len() < 6 || !numbers.len().is_multiple_of(2) {
        return Err("give at least three corners: x0,z0,x1,z1,x2,z2".into());
    }
    let corners: Vec<String> =
        numbers.chunks(2).map(|c| format!("[{:?}, {:?}]", c[0], c[1])).collect();
    Ok(format!("[{}]", corners.join(", ")))
}

fn parse_range(text: &str) -> Result<String, String> {
    match numbers(text)?[..] {
        [both] => Ok(format!("[{both:?}, {both:?}]")),
        [low, high] => Ok(format!("[{low:?}, {high:?}]")),
        _ => Err("give two numbers: lowest,highest".into()),
    }
}

fn parse_point(text: &str) -> Result<glam::DVec3, String> {
    match numbers(text)?[..] {
        [x, y, z] => Ok(glam::DVec3::new(x, y, z)),
        _ => Err("give three numbers: x,y,z".into()),
    }
}

fn parse_moment(text: &str) -> Result<sightline_geometry::Moment, String> {
    let parse = |text: &str| {
        let (state, t) = text.split_once(',')?;
        let t: f64 = t.trim().parse().ok()?;
        let moment = sightline_geometry::Moment { state: state.trim().parse().ok()?, t };
        (0.0..=1.0).contains(&t).then_some(moment)
    };
    parse(text).ok_or_else(|| "give a state and a share of it from 0 to 1: state,t".into())
}

fn parse_cell(text: &str) -> Result<CellId, String> {
    text.parse().map(CellId).map_err(|_| "a cell has a number from 0".into())
}

/// A count: `200000`, `200_000`, `200k`, `3.7M`.
fn parse_count(text: &str) -> Result<u64, String> {
    let plain = text.replace('_', "");
    let (digits, factor) = match plain.as_bytes().last() {
        Some(b'k' | b'K') => (&plain[..plain.len() - 1], 1e3),
        Some(b'M') => (&plain[..plain.len() - 1], 1e6),
        _ => (plain.as_str(), 1.0),
    };
    let exact = if factor == 1.0 { digits.parse::<u64>().ok() } else { None };
    let scaled = digits.parse::<f64>().ok().map(|n| (n * factor).round());
    // Above 2^53 only plain integers are exact.
    let scaled = scaled.filter(|n| (0.0..9.0e15).contains(n)).map(|n| n as u64);
    exact.or(scaled).ok_or_else(|| "give a number such as 200000, 200k or 3.7M".into())
}

fn parse_rays(text: &str) -> Result<u32, String> {
    match u32::try_from(parse_count(text)?) {
        Ok(rays) if rays > 0 => Ok(rays),
        _ => Err("give 1 to 4294967295 rays".into()),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;
    use sightline_jobs::BakeConfig;

    use super::*;

    fn bake(flags: &[&str]) -> ConfigFlags {
        let base = ["sightline", "bake", "scene.glb", "--out", "dir"];
        let arguments = Arguments::try_parse_from(base.iter().chain(flags)).unwrap();
        match arguments.command {
            Task::Bake(bake) => bake.input.keys,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_command_line_is_sound() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn long_help_documents_every_key() {
        let mut command = Arguments::command();
        let help = command.find_subcommand_mut("bake").unwrap().render_long_help().to_string();
        for key in KEYS {
            assert!(help.contains(&format!("`{}`", key.key)), "{}", key.key);
            assert!(help.contains(&format!("--{} ", flag(key))), "{}", flag(key));
        }
    }

    #[test]
    fn flags_become_configuration() {
        let flags = bake(&[
            "--region=-5,-5,5,5",
            "--region",
            "10,0,20,5.5",
            "--polygon",
            "0,0,-1,0,0,1",
            "--cell-size",
            "5",
            "--eye-height",
            "1.6",
            "--heights",
            "absolute",
            "--ground-from",
            "-2.5",
            "--see-through",
            "*leaf*",
            "--see-through",
            "a \"quoted\" name",
            "--rows",
            "100",
            "--verticals",
            "true",
            "--target-error",
            "1e-4",
        ]);
        let borrowed: Vec<(&str, &str)> =
            flags.overrides.iter().map(|(k, v)| (*k, v.as_str())).collect();
        let config =
            BakeConfig::from_toml_with("[solver]\nrings = 3\nrows = 7", &borrowed).unwrap();
        assert_eq!(config.region.rectangles, [[-5.0, -5.0, 5.0, 5.0], [10.0, 0.0, 20.0, 5.5]]);
        assert_eq!(config.region.polygons, [vec![[0.0, 0.0], [-1.0, 0.0], [0.0, 1.0]]]);
        assert_eq!(config.region.cell_size, 5.0);
        assert_eq!(config.region.eye_height, [1.6, 1.6]);
        assert_eq!(config.region.ground_from, Some(-2.5));
        assert_eq!(config.scene.see_through, ["*leaf*", "a \"quoted\" name"]);
        assert_eq!((config.solver.rows, config.solver.rings), (100, 3));
        assert!(config.solver.verticals);
        assert_eq!(config.accuracy.target_error, 1e-4);
    }

    #[test]
    fn an_empty_pattern_means_no_pattern() {
        let flags = bake(&["--see-through", "", "--region", "0,0,1,1"]);
        assert_eq!(flags.overrides[0], ("scene.see_through", "[]".to_owned()));
    }

    #[test]
    fn counts_and_points_are_understood() {
        assert_eq!(parse_count("200k"), Ok(200_000));
        assert_eq!(parse_count("3.7M"), Ok(3_700_000));
        assert_eq!(parse_count("1_000"), Ok(1000));
        assert!(parse_count("-1").is_err() && parse_count("k").is_err());
        assert_eq!(parse_point("1,-2.5,3e2"), Ok(glam::DVec3::new(1.0, -2.5, 300.0)));
        assert!(parse_point("1,2").is_err() && parse_point("1,2,inf").is_err());
        assert!(parse_rays("0").is_err());
        assert_eq!("12".parse(), Ok(CellChoice::Spread(12)));
    }

    #[test]
    fn wrong_shapes_are_refused_with_the_right_form() {
        let parse = |flag: &[&str]| {
            let base = ["sightline", "bake", "s.glb", "--out", "d"];
            Arguments::try_parse_from(base.iter().chain(flag)).unwrap_err().to_string()
        };
        assert!(parse(&["--region", "1,2,3"]).contains("x0,z0,x1,z1"));
        assert!(parse(&["--region", "1,2,3,x"]).contains("`x` is not a number"));
        assert!(parse(&["--cell-sise", "3"]).contains("--cell-size"));
    }
}
