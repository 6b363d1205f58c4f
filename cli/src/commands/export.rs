//! `plat export`: writes a model in a format that other programs read.

use std::path::Path;

use serde::Serialize;

use crate::args::{ExportArgs, Format};
use crate::failure::{Failure, make_folder};
use crate::output::Output;

#[derive(Serialize)]
struct Exported<'a> {
    command: &'static str,
    out: &'a Path,
    splats: u64,
    bytes: u64,
    antialiased: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    levels: Option<u8>,
    files: usize,
}

pub(crate) fn run(args: &ExportArgs, output: &Output) -> Result<(), Failure> {
    let exported = write(args, output)?;
    let text = format!("{} splats, {} bytes\n{}", exported.splats, exported.bytes, args.out.display());
    output.result(&exported, &text)
}

pub(crate) fn make_parent(out: &Path) -> Result<(), Failure> {
    out.parent().filter(|folder| !folder.as_os_str().is_empty()).map_or(Ok(()), make_folder)
}

/// Writes the model block by block.
fn write<'a>(args: &'a ExportArgs, output: &Output) -> Result<Exported<'a>, Failure> {
    let mut progress = None;
    let mut report = |done: usize, all: usize| {
        progress.get_or_insert_with(|| output.progress("blocks", all as u64)).at(done as u64, "");
    };
    let is_file = matches!(args.to, Format::Ply | Format::Spz | Format::Rad);
    if is_file {
        make_parent(&args.out)?;
    }
    let written = match args.to {
        Format::Ply => model::write_ply(&args.model, &args.out, &mut report)?,
        Format::Spz => model::write_spz(&args.model, &args.out, &mut report)?,
        Format::Rad => model::write_rad(&args.model, &args.out, &mut report)?,
        Format::Tiles => model::write_tiles(&args.model, &args.out, &mut report)?,
        Format::Sog => model::write_streamed_sog(&args.model, &args.out, &mut report)?,
    };
    Ok(Exported {
        command: "export",
        out: &args.out,
        splats: written.splats,
        bytes: written.bytes,
        antialiased: written.antialiased,
        levels: (!is_file).then_some(written.levels),
        files: written.files,
    })
}
