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
    splats: u64,
    bytes: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    antialiased: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    levels: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    files: Option<usize>,
}

pub(crate) fn run(args: &ExportArgs, output: &Output) -> Result<(), Failure> {
    let exported = match args.to {
        Format::Ply | Format::Spz => file(args)?,
        Format::Sog | Format::Rad | Format::Tiles => streamed(args, output)?,
    };
    let text = format!("{} splats, {} bytes\n{}", exported.splats, exported.bytes, args.out.display());
    output.result(&exported, &text)
}

fn file(args: &ExportArgs) -> Result<Exported<'_>, Failure> {
    let model = model::read(&args.model)?;
    let bytes = if args.to == Format::Spz { model.to_spz()? } else { model.to_ply() };
    make_parent(&args.out)?;
    save(&args.out, &bytes)?;
    Ok(Exported {
        command: "export",
        out: &args.out,
        splats: model.splats.len() as u64,
        bytes: bytes.len() as u64,
        antialiased: Some(model.antialiased),
        levels: None,
        files: None,
    })
}

pub(super) fn make_parent(out: &Path) -> Result<(), Failure> {
    out.parent().filter(|folder| !folder.as_os_str().is_empty()).map_or(Ok(()), make_folder)
}

/// Writes a format that is read block by block.
fn streamed<'a>(args: &'a ExportArgs, output: &Output) -> Result<Exported<'a>, Failure> {
    let mut progress = None;
    let mut report = |done: usize, all: usize| {
        progress.get_or_insert_with(|| output.progress("blocks", all as u64)).at(done as u64, "");
    };
    let written = match args.to {
        Format::Rad => {
            make_parent(&args.out)?;
            model::write_rad(&args.model, &args.out, &mut report)?
        }
        Format::Tiles => model::write_tiles(&args.model, &args.out, &mut report)?,
        _ => model::write_streamed_sog(&args.model, &args.out, &mut report)?,
    };
    Ok(Exported {
        command: "export",
        out: &args.out,
        splats: written.splats,
        bytes: written.bytes,
        antialiased: None,
        levels: (args.to != Format::Rad).then_some(written.levels),
        files: Some(written.files),
    })
}
