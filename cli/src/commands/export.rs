//! `plat export`: writes a model in a format that other programs read.

use std::path::Path;

use serde::Serialize;
use store::file::save;

use crate::args::{ExportArgs, Format};
use crate::failure::{Failure, make_folder};
use crate::output::Output;

#[derive(Serialize)]
struct Exported<'a> {
    command: &'static str,
    out: &'a Path,
    splats: usize,
    bytes: u64,
    antialiased: bool,
}

pub(crate) fn run(args: &ExportArgs, output: &Output) -> Result<(), Failure> {
    let model = model::read(&args.model)?;
    let bytes = match args.to {
        Format::Ply => model.to_ply(),
        Format::Spz => model.to_spz()?,
    };
    if let Some(folder) = args.out.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        make_folder(folder)?;
    }
    save(&args.out, &bytes)?;
    let exported = Exported {
        command: "export",
        out: &args.out,
        splats: model.splats.len(),
        bytes: bytes.len() as u64,
        antialiased: model.antialiased,
    };
    output.result(&exported, &format!("{} splats, {} bytes\n{}", exported.splats, bytes.len(), args.out.display()))
}
