//! `sightline export`: what one cell sees, as glTF.

use crate::arguments::Export;
use crate::failure::{Failure, Kind, Result};

pub fn run(command: &Export) -> Result<()> {
    let runtime = super::runtime()?;
    let (dataset, _scene, _path) =
        runtime.block_on(super::dataset::open_with_scene(&command.input))?;
    super::expect_cell(&dataset, command.cell)?;
    let _row = runtime.block_on(dataset.cell(command.cell))?;
    Err(Failure::new(Kind::Defect, "export is not there yet"))
}
