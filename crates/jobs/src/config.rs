//! The configuration of a bake: what is asked of the dataset, and how the work is cut.
//!
//! The written form is TOML with one table a concern. [`KEYS`] documents every key once; help
//! texts and pages are made from it, and a test compares it with the structs below.
//!
//! The dataset is a function of the scene and of every section but `[tasks]`: [`BakeConfig::hash`]
//! covers exactly those sections. Where something moves there is one exception: a cell is measured and
//! refined range by range of states, so what refinement adds depends on `tasks.states_per_task`, as it
//! does on where held-out rays happen to start.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Everything a user can decide about a bake.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BakeConfig {
    /// How objects take part.
    pub scene: SceneConfig,
    /// Where viewers can be.
    pub region: RegionConfig,
    /// How densely directions are sampled.
    pub solver: SolverConfig,
    /// How close to the full scene the sets have to come.
    pub accuracy: AccuracyConfig,
    /// How the work is cut into tasks. Does not change the dataset of a scene at rest.
    pub tasks: TaskConfig,
}

/// `[scene]`: how objects take part, by glob patterns on their names, and what moves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SceneConfig {
    /// Objects that can be seen but hide nothing.
    pub see_through: Vec<String>,
    /// Objects that viewers can stand on.
    pub ground: Vec<String>,
    /// Which of the file's animations moves the scene: a name, a number, `all` or `none`; absent: as
    /// the reader of scenes has it.
    #[serde(skip_serializing_if = "Option::is_none", deserialize_with = "name_or_number")]
    pub animation: Option<String>,
    /// How far a vertex may be from where its animation has it, metres.
    pub motion_error: f64,
    /// Files with particles.
    pub particles: Vec<String>,
}

/// A name, or a number that stands for its decimal form.
fn name_or_number<'de, D: serde::Deserializer<'de>>(from: D) -> Result<Option<String>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "expected a name or a number from 0")]
    enum Written {
        Name(String),
        Number(u32),
    }
    Ok(Some(match Written::deserialize(from)? {
        Written::Name(name) => name,
        Written::Number(number) => number.to_string(),
    }))
}

/// `[region]`: where viewers can be.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RegionConfig {
    /// Boxes `[x0, z0, x1, z1]` on the ground plane, metres.
    pub rectangles: Vec<[f64; 4]>,
    /// Simple polygons of `[x, z]` corners on the ground plane, metres.
    pub polygons: Vec<Vec<[f64; 2]>>,
    /// Side of a view cell, metres.
    pub cell_size: f64,
    /// Lowest and highest eye position, metres.
    pub eye_height: [f64; 2],
    /// What eye heights are measured from.
    pub heights: Heights,
    /// World y where the ray that looks for the ground starts; absent: the top of the scene.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ground_from: Option<f64>,
}

/// What the eye heights of a region are measured from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Heights {
    /// The ground below each corner of a cell.
    #[default]
    Ground,
    /// World y = 0.
    Absolute,
}

impl fmt::Display for Heights {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Ground => "ground",
            Self::Absolute => "absolute",
        })
    }
}

/// `[solver]`: how densely directions are sampled, and along which segments.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SolverConfig {
    /// Rows of a face of the rectified frame, for the segments that cells share; a face has as
    /// many columns.
    pub rows: u32,
    /// Most rows that refinement may give to a segment of one cell.
    pub rows_max: u32,
    /// Horizontal perimeters of a cell that are solved, from the lower to the upper eye height.
    pub rings: u32,
    /// Whether the vertical edges of a cell are solved too.
    pub verticals: bool,
}

/// `[accuracy]`: the pixel error aimed at, and how it is measured and lowered.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AccuracyConfig {
    /// Mean pixel error of a cell that is aimed at, share of pixels, with 95 % confidence.
    pub target_error: f64,
    /// Pixel error aimed at for the worst held-out viewpoint of a cell, share of pixels.
    pub worst_error: f64,
    /// Refinement rounds at most; 0 switches refinement off.
    pub rounds: u32,
}

/// `[tasks]`: how the work is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TaskConfig {
    /// Segments of a segments task.
    pub segments_per_task: u32,
    /// Cells of a cells task.
    pub cells_per_task: u32,
    /// States of a segments or cells task.
    pub states_per_task: u32,
}

impl Default for SceneConfig {
    fn default() -> Self {
        Self {
            see_through: vec!["*glass*".into()],
            ground: vec!["*".into()],
            animation: None,
            motion_error: 0.01,
            particles: Vec::new(),
        }
    }
}

impl Default for RegionConfig {
    fn default() -> Self {
        Self {
            rectangles: Vec::new(),
            polygons: Vec::new(),
            cell_size: 10.0,
            eye_height: [1.5, 1.8],
            heights: Heights::Ground,
            ground_from: None,
        }
    }
}

impl Default for SolverConfig {
    fn default() -> Self {
        Self { rows: 24, rows_max: 512, rings: 1, verticals: false }
    }
}

impl Default for AccuracyConfig {
    fn default() -> Self {
        Self { target_error: 0.0002, worst_error: 0.002, rounds: 8 }
    }
}

impl Default for TaskConfig {
    fn default() -> Self {
        Self { segments_per_task: 32, cells_per_task: 16, states_per_task: 32 }
    }
}

/// What one key means, for help texts and pages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KeyDoc {
    /// Full name, `section.key`.
    pub key: &'static str,
    /// Type of the value, in words.
    pub kind: &'static str,
    /// Default, as it would be written in TOML; empty when the key is optional and absent.
    pub default: &'static str,
    /// Unit of the value; empty when it has none.
    pub unit: &'static str,
    /// What the key does.
    pub doc: &'static str,
}

const fn key(
    key: &'static str,
    kind: &'static str,
    default: &'static str,
    unit: &'static str,
    doc: &'static str,
) -> KeyDoc {
    KeyDoc { key, kind, default, unit, doc }
}

/// Every key of the configuration, in the order of the sections.
pub const KEYS: &[KeyDoc] = &[
    key(
        "scene.see_through",
        "list of glob patterns",
        "[\"*glass*\"]",
        "",
        "Names of objects that can be seen but hide nothing behind them.",
    ),
    key(
        "scene.ground",
        "list of glob patterns",
        "[\"*\"]",
        "",
        "Names of objects that viewers can stand on.",
    ),
    key(
        "scene.animation",
        "text or an integer",
        "",
        "",
        "The animation of the scene file that moves it: its name or its number from 0, \"all\" to play \
         all of them at once, or \"none\" to bake the scene at rest; absent: the first where there is \
         one.",
    ),
    key(
        "scene.motion_error",
        "number",
        "0.01",
        "metres",
        "Farthest that anything may be from where its animation has it: key frames are chosen so that \
         straight motion between them stays within it. Smaller values give more states.",
    ),
    key(
        "scene.particles",
        "list of paths",
        "[]",
        "",
        "Files with particles, spheres that are seen beside the triangles of the scene; relative paths \
         start at the scene file.",
    ),
    key(
        "region.rectangles",
        "list of [x0, z0, x1, z1]",
        "[]",
        "metres",
        "Boxes on the ground plane where viewers can be. \
         At least one rectangle or polygon is required.",
    ),
    key(
        "region.polygons",
        "list of lists of [x, z]",
        "[]",
        "metres",
        "Simple polygons on the ground plane where viewers can be.",
    ),
    key("region.cell_size", "number", "10.0", "metres", "Side of a view cell."),
    key(
        "region.eye_height",
        "[lowest, highest]",
        "[1.5, 1.8]",
        "metres",
        "Range of eye positions, measured from what region.heights says.",
    ),
    key(
        "region.heights",
        "\"ground\" or \"absolute\"",
        "\"ground\"",
        "",
        "What eye heights are measured from: the ground below each corner of a cell, or world y = 0.",
    ),
    key(
        "region.ground_from",
        "number",
        "",
        "metres",
        "World y where the downward ray that looks for the ground starts; \
         absent: above the whole scene. Set it below roofs and bridges to stand under them.",
    ),
    key(
        "solver.rows",
        "integer",
        "24",
        "rows a face",
        "Rows of a face of the image, for the segments that cells share; a face has as many \
         columns. Cells that need more get it by refinement; without refinement, more rows find \
         smaller primitives and cost more time.",
    ),
    key(
        "solver.rows_max",
        "integer",
        "512",
        "rows a face",
        "Most rows that refinement may give to a segment of one cell.",
    ),
    key(
        "solver.rings",
        "integer",
        "1",
        "perimeters a cell",
        "Horizontal perimeters of a cell that cells share, spread from the lowest to the highest \
         eye position; 1 stands for the middle. Refinement adds others where they are needed.",
    ),
    key(
        "solver.verticals",
        "true or false",
        "false",
        "",
        "Whether the vertical edges at the corners of a cell are solved too.",
    ),
    key(
        "accuracy.target_error",
        "number",
        "0.0002",
        "share of pixels",
        "Mean pixel error of a cell that is aimed at. Resolution, runs and lines are chosen cell by \
         cell until held-out viewpoints say with 95 % confidence that it is met, or \
         accuracy.rounds are used up.",
    ),
    key(
        "accuracy.worst_error",
        "number",
        "0.002",
        "share of pixels",
        "Pixel error at the worst held-out viewpoint of a cell that refinement aims at.",
    ),
    key(
        "accuracy.rounds",
        "integer",
        "8",
        "rounds",
        "Refinement rounds of a cell at most; 0 measures and refines nothing, so that all segments \
         have solver.rows.",
    ),
    key(
        "tasks.segments_per_task",
        "integer",
        "32",
        "segments",
        "Segments that a worker solves in one task. Does not change the dataset.",
    ),
    key(
        "tasks.cells_per_task",
        "integer",
        "16",
        "cells",
        "Cells that a worker finishes in one task. Does not change the dataset.",
    ),
    key(
        "tasks.states_per_task",
        "integer",
        "32",
        "states",
        "States of a moving scene that a worker takes in one task. Each cell is measured and refined \
         once for all states of a task; a scene at rest has one state, and its dataset does not change.",
    ),
];

/// Why a configuration was refused. Every kind is one for the user to fix.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ConfigError {
    /// The text is not TOML.
    #[error("the configuration is not valid TOML: {message}")]
    Syntax {
        /// What the parser says, with line and column.
        message: String,
    },
    /// A key that does not exist.
    #[error("there is no configuration key `{key}`{}", did_you_mean(.suggestion.as_deref()))]
    UnknownKey {
        /// The key as written, with its section.
        key: String,
        /// The closest key there is.
        suggestion: Option<String>,
    },
    /// A value of the wrong type.
    #[error("`{key}` has to be {expected}: {message}")]
    WrongType {
        /// The key, with its section.
        key: String,
        /// What it has to be.
        expected: String,
        /// What was found.
        message: String,
    },
    /// A value that has the right type and makes no sense.
    #[error("`{key} = {value}` {problem}; {fix}")]
    Invalid {
        /// The key, with its section.
        key: &'static str,
        /// The value, as it was understood.
        value: String,
        /// What is wrong with it.
        problem: &'static str,
        /// What to do.
        fix: &'static str,
    },
}

fn did_you_mean(suggestion: Option<&str>) -> String {
    suggestion.map_or_else(String::new, |s| format!("; did you mean `{s}`?"))
}

/// Most rows a face may have: the solver counts pixels of a face in 32 bits.
pub const ROWS_MAX: u32 = 16_384;
/// Most perimeters a cell may have.
pub const RINGS_MAX: u32 = 64;
/// Most units of work a task may have: its output is held in memory.
pub const TASK_UNITS_MAX: u32 = 65_536;

impl BakeConfig {
    /// Reads and validates the TOML form.
    ///
    /// # Errors
    /// The first thing that is wrong, naming the key.
    pub fn from_toml(text: &str) -> Result<Self, ConfigError> {
        Self::from_toml_with(text, &[])
    }

    /// As [`Self::from_toml`], with `(section.key, TOML value)` pairs put in place of what the
    /// text says. A value that is not TOML is taken as a string.
    ///
    /// # Errors
    /// The first thing that is wrong, naming the key.
    pub fn from_toml_with(text: &str, overrides: &[(&str, &str)]) -> Result<Self, ConfigError> {
        let mut table: toml::Table =
            text.parse().map_err(|e| ConfigError::Syntax { message: one_line(&e) })?;
        for (key, value) in overrides {
            put(&mut table, key, value)?;
        }
        check_keys(&table)?;
        let config = read_table(&table)?;
        config.validate()?;
        Ok(config)
    }

    /// The configuration as TOML that [`Self::from_toml`] reads back.
    #[must_use]
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a configuration always has a TOML form")
    }

    /// Everything the dataset depends on, as JSON with a fixed order of keys: all but `[tasks]`.
    #[must_use]
    pub fn canonical_json(&self) -> String {
        #[derive(Serialize)]
        struct Canonical<'a> {
            scene: &'a SceneConfig,
            region: &'a RegionConfig,
            solver: &'a SolverConfig,
            accuracy: &'a AccuracyConfig,
        }
        let Self { scene, region, solver, accuracy, tasks: _ } = self;
        serde_json::to_string(&Canonical { scene, region, solver, accuracy })
            .expect("a configuration always has a JSON form")
    }

    /// BLAKE3 of [`Self::canonical_json`], hexadecimal.
    #[must_use]
    pub fn hash(&self) -> String {
        blake3::hash(self.canonical_json().as_bytes()).to_hex().to_string()
    }

    /// Checks what types cannot say.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] for the first value that makes no sense.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.scene.validate()?;
        self.region.validate()?;
        self.solver.validate()?;
        self.accuracy.validate()?;
        self.tasks.validate()
    }
}

impl SceneConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        let empty = |p: &Vec<String>| p.iter().any(String::is_empty);
        require(
            !empty(&self.see_through),
            "scene.see_through",
            &self.see_through,
            "holds an empty pattern",
            "remove it, or write [] when nothing is see-through",
        )?;
        require(
            !empty(&self.ground),
            "scene.ground",
            &self.ground,
            "holds an empty pattern",
            "remove it, or write [\"*\"] to stand on everything",
        )?;
        require(
            self.animation.as_ref().is_none_or(|name| !name.is_empty()),
            "scene.animation",
            &self.animation,
            "names no animation",
            "give a name, a number, \"all\" or \"none\", or leave the key out",
        )?;
        require(
            self.motion_error.is_finite() && self.motion_error > 0.0,
            "scene.motion_error",
            &self.motion_error,
            "is not a distance",
            "give a distance in metres above 0, for example 0.01",
        )?;
        require(
            !empty(&self.particles),
            "scene.particles",
            &self.particles,
            "holds an empty path",
            "remove it, or write [] when there are no particles",
        )
    }
}

impl RegionConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        self.validate_outline()?;
        require(
            self.cell_size.is_finite() && self.cell_size > 0.0,
            "region.cell_size",
            &self.cell_size,
            "is not a length",
            "give the side of a cell in metres, for example 10.0",
        )?;
        let [low, high] = self.eye_height;
        require(
            low.is_finite() && high.is_finite() && low <= high,
            "region.eye_height",
            &self.eye_height,
            "is not a range",
            "give the lowest eye position first, for example [1.5, 1.8]",
        )?;
        require(
            self.heights == Heights::Absolute || low > 0.0,
            "region.eye_height",
            &self.eye_height,
            "puts eyes on or in the ground",
            "give heights above 0, or set region.heights = \"absolute\"",
        )?;
        require(
            self.ground_from.is_none_or(f64::is_finite),
            "region.ground_from",
            &self.ground_from,
            "is not a height",
            "give a world y in metres, or leave the key out",
        )
    }

    fn validate_outline(&self) -> Result<(), ConfigError> {
        require(
            !(self.rectangles.is_empty() && self.polygons.is_empty()),
            "region.rectangles",
            &self.rectangles,
            "leaves no place to stand",
            "give at least one rectangle [x0, z0, x1, z1] or one polygon in region.polygons",
        )?;
        for rectangle in &self.rectangles {
            let [x0, z0, x1, z1] = *rectangle;
            require(
                rectangle.iter().all(|v| v.is_finite()) && x0 < x1 && z0 < z1,
                "region.rectangles",
                rectangle,
                "is not a rectangle",
                "write [x0, z0, x1, z1] with x0 < x1 and z0 < z1",
            )?;
        }
        for polygon in &self.polygons {
            require(
                polygon.len() >= 3 && polygon.iter().flatten().all(|v| v.is_finite()),
                "region.polygons",
                polygon,
                "is not a polygon",
                "give at least three corners [x, z] of finite numbers",
            )?;
        }
        Ok(())
    }
}

impl SolverConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        require(
            (2..=ROWS_MAX).contains(&self.rows),
            "solver.rows",
            &self.rows,
            "is out of range",
            "use 2 to 16384 rows; 24 suit most scenes, 100 to 400 where nothing is refined",
        )?;
        require(
            (self.rows..=ROWS_MAX).contains(&self.rows_max),
            "solver.rows_max",
            &self.rows_max,
            "is out of range",
            "use at least solver.rows and at most 16384",
        )?;
        require(
            (1..=RINGS_MAX).contains(&self.rings),
            "solver.rings",
            &self.rings,
            "is out of range",
            "use 1 to 64 perimeters; 1 suits most scenes",
        )
    }
}

impl AccuracyConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        let share = |v: f64| v.is_finite() && v > 0.0 && v <= 1.0;
        require(
            share(self.target_error),
            "accuracy.target_error",
            &self.target_error,
            "is not a share of pixels",
            "use a number above 0 and at most 1; 0.0002 is one pixel in 5000",
        )?;
        require(
            share(self.worst_error),
            "accuracy.worst_error",
            &self.worst_error,
            "is not a share of pixels",
            "use a number above 0 and at most 1; ten times accuracy.target_error is common",
        )?;
        require(
            self.worst_error >= self.target_error,
            "accuracy.worst_error",
            &self.worst_error,
            "is below accuracy.target_error",
            "raise it to at least the target: the worst error cannot be under the mean",
        )?;
        require(
            self.rounds <= 1000,
            "accuracy.rounds",
            &self.rounds,
            "is out of range",
            "use at most 1000; 8 suit most scenes",
        )
    }
}

impl TaskConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        let fits = |v: u32| (1..=TASK_UNITS_MAX).contains(&v);
        require(
            fits(self.segments_per_task),
            "tasks.segments_per_task",
            &self.segments_per_task,
            "is out of range",
            "use 1 to 65536; 32 suit most scenes",
        )?;
        require(
            fits(self.cells_per_task),
            "tasks.cells_per_task",
            &self.cells_per_task,
            "is out of range",
            "use 1 to 65536; 16 suit most scenes",
        )?;
        require(
            fits(self.states_per_task),
            "tasks.states_per_task",
            &self.states_per_task,
            "is out of range",
            "use 1 to 65536; 32 suit most scenes",
        )
    }
}

fn require(
    holds: bool,
    key: &'static str,
    value: &impl Serialize,
    problem: &'static str,
    fix: &'static str,
) -> Result<(), ConfigError> {
    if holds {
        return Ok(());
    }
    let value = serde_json::to_string(value).unwrap_or_else(|_| "?".into());
    Err(ConfigError::Invalid { key, value, problem, fix })
}

fn put(table: &mut toml::Table, key: &str, value: &str) -> Result<(), ConfigError> {
    let Some((section, name)) = key.split_once('.') else {
        return Err(unknown(key));
    };
    let value = format!("v = {value}")
        .parse::<toml::Table>()
        .ok()
        .and_then(|mut t| t.remove("v"))
        .unwrap_or_else(|| toml::Value::String(value.to_owned()));
    let section = table
        .entry(section)
        .or_insert_with(|| toml::Value::Table(toml::Table::new()))
        .as_table_mut()
        .ok_or_else(|| not_a_section(section))?;
    section.insert(name.to_owned(), value);
    Ok(())
}

/// Refuses keys that do not exist, naming the closest that does.
fn check_keys(table: &toml::Table) -> Result<(), ConfigError> {
    for (section, value) in table {
        if !KEYS.iter().any(|k| section_of(k.key) == section) {
            return Err(unknown(section));
        }
        let Some(value) = value.as_table() else {
            return Err(not_a_section(section));
        };
        for name in value.keys() {
            let full = format!("{section}.{name}");
            if !KEYS.iter().any(|k| k.key == full) {
                return Err(unknown(&full));
            }
        }
    }
    Ok(())
}

/// Reads a table whose keys all exist. When that fails, every key is tried alone, so that the
/// error can name the one whose type is wrong.
fn read_table(table: &toml::Table) -> Result<BakeConfig, ConfigError> {
    let Err(whole) = table.clone().try_into::<BakeConfig>() else {
        return Ok(table.clone().try_into().expect("it was read a moment ago"));
    };
    for (section, values) in table {
        for (name, value) in values.as_table().into_iter().flatten() {
            let inner = toml::Table::from_iter([(name.clone(), value.clone())]);
            let alone = toml::Table::from_iter([(section.clone(), toml::Value::Table(inner))]);
            if let Err(error) = alone.try_into::<BakeConfig>() {
                return Err(wrong_type(&format!("{section}.{name}"), &error));
            }
        }
    }
    Err(ConfigError::Syntax { message: one_line(&whole) })
}

fn wrong_type(key: &str, error: &toml::de::Error) -> ConfigError {
    let expected = KEYS.iter().find(|k| k.key == key).map_or("of another type", |k| k.kind);
    let article = match expected.as_bytes().first() {
        Some(b'i') => "an ",
        Some(b'l' | b'n') => "a ",
        _ => "",
    };
    ConfigError::WrongType {
        key: key.to_owned(),
        expected: format!("{article}{expected}"),
        message: error.message().to_owned(),
    }
}

fn not_a_section(section: &str) -> ConfigError {
    ConfigError::WrongType {
        key: section.to_owned(),
        expected: format!("a section, written [{section}]"),
        message: "found a plain value".into(),
    }
}

fn unknown(written: &str) -> ConfigError {
    ConfigError::UnknownKey { key: written.to_owned(), suggestion: closest(written) }
}

/// Least likeness, of 1, at which another name is worth suggesting: below it, suggestions are
/// names that share a few letters by chance.
const LIKENESS_MIN: f64 = 0.6;

/// The closest key, or the closest section when `written` has no dot; also finds a key that was
/// put in the wrong section.
fn closest(written: &str) -> Option<String> {
    let last = |s: &str| s.rsplit('.').next().unwrap_or(s).to_owned();
    let sections = KEYS.iter().map(|k| section_of(k.key));
    let likeness = |candidate: &str| {
        strsim::normalized_levenshtein(written, candidate)
            .max(strsim::normalized_levenshtein(&last(written), &last(candidate)))
    };
    KEYS.iter()
        .map(|k| k.key)
        .chain(sections.filter(|_| !written.contains('.')))
        .map(|candidate| (likeness(candidate), candidate))
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .filter(|(likeness, _)| *likeness >= LIKENESS_MIN)
        .map(|(_, candidate)| candidate.to_owned())
}

fn section_of(key: &str) -> &str {
    key.split('.').next().unwrap_or(key)
}

fn one_line(error: &toml::de::Error) -> String {
    error.to_string().trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    const REGION: &str = "[region]\nrectangles = [[0, 0, 10, 20.5]]\n";

    fn from(rest: &str) -> Result<BakeConfig, ConfigError> {
        BakeConfig::from_toml(&format!("{REGION}{rest}"))
    }

    #[test]
    fn only_the_region_has_no_default() {
        let config = from("").unwrap();
        assert_eq!(config.region.rectangles, [[0.0, 0.0, 10.0, 20.5]]);
        assert_eq!(config.solver, SolverConfig::default());
        assert!(matches!(
            BakeConfig::from_toml(""),
            Err(ConfigError::Invalid { key: "region.rectangles", .. })
        ));
    }

    #[test]
    fn key_docs_and_structs_agree() {
        let serde_json::Value::Object(sections) =
            serde_json::to_value(BakeConfig::default()).unwrap()
        else {
            unreachable!("a struct is an object")
        };
        let mut in_struct: Vec<String> = sections
            .iter()
            .flat_map(|(s, keys)| keys.as_object().unwrap().keys().map(move |k| format!("{s}.{k}")))
            .collect();
        // Absent by default.
        in_struct.extend(["region.ground_from".into(), "scene.animation".into()]);
        let mut documented: Vec<String> = KEYS.iter().map(|k| k.key.to_owned()).collect();
        in_struct.sort();
        documented.sort();
        assert_eq!(documented, in_struct);

        let mut text = String::new();
        for k in KEYS.iter().filter(|k| !k.default.is_empty()) {
            text += &format!("{} = {}\n", k.key, k.default);
        }
        let table: toml::Table = text.parse().unwrap();
        assert_eq!(table.try_into::<BakeConfig>().unwrap(), BakeConfig::default());
    }

    #[test]
    fn an_unknown_key_names_the_closest() {
        let suggestion = |rest: &str| match from(rest) {
            Err(ConfigError::UnknownKey { key, suggestion }) => (key, suggestion),
            other => panic!("{other:?}"),
        };
        assert_eq!(
            suggestion("[solver]\nrow = 3\n"),
            ("solver.row".into(), Some("solver.rows".into()))
        );
        assert_eq!(suggestion("[solvr]\nrows = 3\n"), ("solvr".into(), Some("solver".into())));
        assert_eq!(
            suggestion("[solver]\ntarget_error = 3\n"),
            ("solver.target_error".into(), Some("accuracy.target_error".into()))
        );
        assert_eq!(suggestion("[solver]\nzzzzz = 3\n").1, None);
        let message = from("[solver]\nrow = 3\n").unwrap_err().to_string();
        assert_eq!(
            message,
            "there is no configuration key `solver.row`; did you mean `solver.rows`?"
        );
    }

    #[test]
    fn a_wrong_type_names_the_key() {
        for (rest, wanted) in [
            ("[solver]\nrows = \"many\"\n", "solver.rows"),
            ("[solver]\nrows = -3\n", "solver.rows"),
            ("heights = \"sea\"\n", "region.heights"),
            ("eye_height = [1.0]\n", "region.eye_height"),
            ("[tasks]\ncells_per_task = 1.5\n", "tasks.cells_per_task"),
            ("[scene]\nanimation = -1\n", "scene.animation"),
        ] {
            match from(rest) {
                Err(ConfigError::WrongType { key, .. }) => assert_eq!(key, wanted),
                other => panic!("{rest}: {other:?}"),
            }
        }
        assert!(matches!(from("solver = 3\n[x"), Err(ConfigError::Syntax { .. })));
    }

    #[test]
    fn values_that_make_no_sense_say_what_to_do() {
        for (rest, wanted) in [
            ("cell_size = 0\n", "region.cell_size"),
            ("cell_size = nan\n", "region.cell_size"),
            ("eye_height = [2.0, 1.0]\n", "region.eye_height"),
            ("eye_height = [0.0, 1.0]\n", "region.eye_height"),
            ("polygons = [[[0,0],[1,1]]]\n", "region.polygons"),
            ("[solver]\nrows = 1\n", "solver.rows"),
            ("[solver]\nrings = 0\n", "solver.rings"),
            ("[accuracy]\ntarget_error = 0.0\n", "accuracy.target_error"),
            ("[accuracy]\nworst_error = 0.0001\n", "accuracy.worst_error"),
            ("[accuracy]\nrounds = 2000\n", "accuracy.rounds"),
            ("[solver]\nrows = 600\n", "solver.rows_max"),
            ("[tasks]\nsegments_per_task = 0\n", "tasks.segments_per_task"),
            ("[tasks]\nstates_per_task = 0\n", "tasks.states_per_task"),
            ("[scene]\nmotion_error = 0.0\n", "scene.motion_error"),
            ("[scene]\nanimation = \"\"\n", "scene.animation"),
            ("[scene]\nparticles = [\"\"]\n", "scene.particles"),
        ] {
            match from(rest) {
                Err(error @ ConfigError::Invalid { key, .. }) => {
                    assert_eq!(key, wanted);
                    assert!(error.to_string().contains("; "), "{error}");
                }
                other => panic!("{rest}: {other:?}"),
            }
        }
    }

    #[test]
    fn the_hash_covers_all_but_the_cutting_into_tasks() {
        let base = from("").unwrap();
        for cut in ["cells_per_task = 3", "states_per_task = 1"] {
            assert_eq!(base.hash(), from(&format!("[tasks]\n{cut}\n")).unwrap().hash());
        }
        for motion in ["motion_error = 0.1", "animation = \"none\"", "particles = [\"a.pts\"]"] {
            assert_ne!(base.hash(), from(&format!("[scene]\n{motion}\n")).unwrap().hash());
        }
        assert_ne!(base.hash(), from("[solver]\nrows = 104\n").unwrap().hash());
        assert_ne!(base.hash(), from("ground_from = 5.0\n").unwrap().hash());
    }

    #[test]
    fn an_animation_has_a_name_or_a_number() {
        let animation = |value: &str| from(&format!("[scene]\nanimation = {value}\n")).unwrap();
        let (one, other) = (animation("3"), animation("\"3\""));
        assert_eq!((&one, one.scene.animation.as_deref()), (&other, Some("3")));
        assert_eq!(BakeConfig::from_toml(&one.to_toml()).unwrap(), one);
        assert_eq!(animation("\"walk\"").scene.animation.as_deref(), Some("walk"));
    }

    #[test]
    fn toml_form_reads_back_and_overrides_win() {
        let config = BakeConfig::from_toml_with(
            REGION,
            &[("solver.rows", "64"), ("region.heights", "absolute")],
        )
        .unwrap();
        assert_eq!((config.solver.rows, config.region.heights), (64, Heights::Absolute));
        assert_eq!(BakeConfig::from_toml(&config.to_toml()).unwrap(), config);
        assert!(matches!(
            BakeConfig::from_toml_with(REGION, &[("rows", "64")]),
            Err(ConfigError::UnknownKey { suggestion: Some(s), .. }) if s == "solver.rows"
        ));
    }
}
