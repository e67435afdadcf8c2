//! What is wrong with a particle table, at which row and column, and what to do about it.

use std::fmt;

/// A row of a table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RowPlace {
    /// Number of the row, counted from 0 without the header.
    pub row: u64,
    /// Line of a CSV file, counted from 1.
    pub line: Option<u64>,
}

impl fmt::Display for RowPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.line {
            Some(line) => write!(f, "row {} (line {line})", self.row),
            None => write!(f, "row {}", self.row),
        }
    }
}

/// Why a particle table is refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TableProblem {
    /// The name of the file says neither Parquet nor CSV.
    #[error("a particle table is a .parquet or a .csv file")]
    Format,
    /// The file is not what its name says, or damaged.
    #[error("the table does not parse{}: {reason}", after(*.place))]
    Malformed {
        /// The row before which it fails, as far as it is known.
        place: Option<RowPlace>,
        /// What the parser says.
        reason: String,
    },
    /// A column is not there.
    #[error("there is no column `{column}`; the columns are {found}")]
    ColumnMissing {
        /// Its name.
        column: &'static str,
        /// The columns that are there, shortened when there are many.
        found: String,
    },
    /// Two columns have the same name.
    #[error("there are two columns `{column}`")]
    ColumnTwice {
        /// The name.
        column: &'static str,
    },
    /// A column of another type.
    #[error("column `{column}` holds {found} and has to hold {wanted}")]
    ColumnType {
        /// Its name.
        column: &'static str,
        /// Its type.
        found: String,
        /// Types that can be read.
        wanted: &'static str,
    },
    /// A value that a column cannot have.
    #[error("{place}, column `{column}`: {value} is refused; {rule}")]
    Value {
        /// The row.
        place: RowPlace,
        /// The column.
        column: &'static str,
        /// The value, shortened when long.
        value: String,
        /// What the column holds.
        rule: &'static str,
    },
    /// Key frames are not in ascending order, or one has no rows.
    #[error(
        "{place}, column `state`: key frame {state} follows {}; rows come by key frames 0, 1, 2 and so on",
        previous.map_or("nothing".to_owned(), |p| format!("key frame {p}"))
    )]
    Order {
        /// The row.
        place: RowPlace,
        /// Its key frame.
        state: u32,
        /// Key frame of the row before it.
        previous: Option<u32>,
    },
    /// The time of a key frame does not fit the rows before it.
    #[error("{place}, column `time`: {time} s does not fit the {other} s before it; {rule}")]
    Time {
        /// The row.
        place: RowPlace,
        /// Its time, seconds.
        time: f64,
        /// Time of the row before it, seconds.
        other: f64,
        /// What is expected.
        rule: &'static str,
    },
    /// A particle is there twice at one key frame.
    #[error("{place}: particle {particle} is there a second time at key frame {state}")]
    Twice {
        /// The second row.
        place: RowPlace,
        /// The particle.
        particle: u32,
        /// The key frame.
        state: u32,
    },
    /// The table has no rows.
    #[error("the table has no rows")]
    Empty,
    /// More spheres than the options allow.
    #[error(
        "the scene has {count} spheres or more, particles times key frames; the limit is {limit}"
    )]
    TooManySpheres {
        /// Spheres that have been counted.
        count: u64,
        /// The limit.
        limit: u64,
    },
    /// More key frames than a scene can have.
    #[error("the scene has {count} key frames or more; the limit is {limit}")]
    TooManyKeyFrames {
        /// Key frames that have been counted.
        count: u64,
        /// The limit.
        limit: u64,
    },
    /// The file changed between the two times that it is read.
    #[error("the file changed while it was read")]
    Changed,
}

fn after(place: Option<RowPlace>) -> String {
    place.map_or(String::new(), |place| format!(" at {place}"))
}

impl TableProblem {
    /// What to do about it, in one or two sentences.
    #[must_use]
    pub fn help(&self) -> &'static str {
        match self {
            Self::Format => "write the table as Parquet or CSV, and name it so",
            Self::Malformed { .. } => {
                "the file was probably cut short or is of another format; write it again. Parquet \
                 may be plain or compressed with zstd, Snappy, LZ4 or gzip; CSV has a header, \
                 commas and one row a line"
            }
            Self::ColumnMissing { .. } | Self::ColumnTwice { .. } | Self::ColumnType { .. } => {
                "a table has the columns particle (whole numbers), x, y, z and radius (metres), \
                 and may have state (number of the key frame) and time (seconds)"
            }
            Self::Value { column: "radius", .. } => {
                "leave out the rows of particles that are not there: a particle without a row at a \
                 key frame is absent"
            }
            Self::Value { .. } => "correct the value, or leave the row out",
            Self::Order { .. } => {
                "sort the rows by state, and number the key frames from 0 without gaps"
            }
            Self::Time { .. } => {
                "give all rows of a key frame the same time, later key frames a later one; or \
                 leave the column out, for one second a state"
            }
            Self::Twice { .. } => {
                "give every particle a number of its own, and one row a key frame"
            }
            Self::Empty => "leave the table out, or write a row for every particle",
            Self::TooManySpheres { .. } => {
                "raise the limit if this machine has the memory (16 bytes a sphere), or use fewer \
                 key frames"
            }
            Self::TooManyKeyFrames { .. } => "use fewer key frames: motion between them is linear",
            Self::Changed => "wait until the file is written, and open the scene again",
        }
    }
}
