//! `plat import`: writes a model of another program as one file.

use std::path::Path;

use scene::{BadInput, GeoOrigin};
use serde::Serialize;
use store::file::save;

use crate::args::ImportArgs;
use crate::commands::export::make_parent;
use crate::failure::Failure;
use crate::output::Output;

#[derive(Serialize)]
struct Imported<'a> {
    command: &'static str,
    /// What the model was.
    format: &'static str,
    out: &'a Path,
    splats: usize,
    sh_degree: u8,
    antialiased: bool,
    /// Where on Earth the origin lies, which neither PLY nor SPZ can say.
    geo_origin: Option<GeoOrigin>,
    bytes: usize,
}

pub(crate) fn run(args: &ImportArgs, output: &Output) -> Result<(), Failure> {
    let is = |wanted: &str| args.out.extension().is_some_and(|extension| extension.eq_ignore_ascii_case(wanted));
    if !is("ply") && !is("spz") {
        let problem = "is neither a .ply nor a .spz";
        return Err(BadInput::new(args.out.display().to_string(), problem, "give one of them with --out").into());
    }
    let (kind, _) = model::kind(&args.model)?;
    let model = model::read(&args.model)?;
    let bytes = if is("spz") { model.to_spz()? } else { model.to_ply() };
    make_parent(&args.out)?;
    save(&args.out, &bytes)?;
    let imported = Imported {
        command: "import",
        format: kind.name(),
        out: &args.out,
        splats: model.splats.len(),
        sh_degree: model.splats.sh_degree(),
        antialiased: model.antialiased,
        geo_origin: model.geo_origin,
        bytes: bytes.len(),
    };
    let text =
        format!("{}: {} splats, {} bytes\n{}", imported.format, imported.splats, imported.bytes, args.out.display());
    output.result(&imported, &text)
}
