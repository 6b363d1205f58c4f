//! Reads models that other programs wrote, and what `plat export` wrote: SOG, streamed SOG, RAD, 3D Tiles. PLY and SPZ are codecs
//! of [`scene`].
//!
//! The kind of a file is told by its content. All of it is of hostile origin: the codecs check sizes before they take memory, and no
//! name in a file leads out of the folder that it lies in ([`Folder`]). The finest splats are read and nothing coarser; they lie where
//! the model had them, as far as the file says where that is.

mod folder;
mod imported;
mod rad;
mod sog;
mod tiles;

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use scene::{BadInput, CodecError, GeoOrigin, ply, spz};
use serde::Deserialize;
use serde::de::IgnoredAny;

use self::folder::unreadable;
pub(crate) use self::imported::Imported;
use crate::ANTIALIASED;
use crate::files::{MANIFEST_FILE, load};

/// A kind of model on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// The folder that `plat train` writes.
    Trained,
    /// PLY of INRIA or of PlayCanvas.
    Ply,
    /// SPZ.
    Spz,
    /// A `.sog`, or the `meta.json` that its files are named in.
    Sog,
    /// `lod-meta.json`.
    StreamedSog,
    /// RAD.
    Rad,
    /// The `tileset.json` of 3D Tiles.
    Tiles,
}

impl Kind {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Trained => "trained model",
            Self::Ply => "PLY",
            Self::Spz => "SPZ",
            Self::Sog => "SOG",
            Self::StreamedSog => "streamed SOG",
            Self::Rad => "RAD",
            Self::Tiles => "3D Tiles",
        }
    }
}

/// What a model can be, for advice.
pub(crate) const ADVICE: &str =
    "give a folder that plat train wrote, or a model as PLY, SPZ, SOG, streamed SOG, RAD or 3D Tiles (tileset.json)";

/// What tells kinds of JSON apart.
#[derive(Deserialize)]
struct Keys {
    filenames: Option<IgnoredAny>,
    means: Option<IgnoredAny>,
    root: Option<IgnoredAny>,
}

/// What the model at `path` is, and the file that it starts with: `path` itself, or the one in that folder.
///
/// # Errors
/// A path that does not exist, cannot be read, or holds no model.
pub fn kind(path: &Path) -> Result<(Kind, PathBuf), BadInput> {
    let bad = |problem: &str| BadInput::new(path.display().to_string(), problem, ADVICE);
    if path.is_dir() {
        let of = |name: &str| Some(path.join(name)).filter(|file| file.is_file());
        if let Some(manifest) = of("model/model.json").or_else(|| of(MANIFEST_FILE)) {
            return Ok((Kind::Trained, manifest));
        }
        let first = [sog::LOD_META, scene::sog::META, tiles::TILESET].into_iter().find_map(of);
        let problem = "holds no model/model.json, lod-meta.json, meta.json or tileset.json";
        return kind(&first.ok_or_else(|| bad(problem))?);
    }
    if !path.exists() {
        return Err(bad("does not exist"));
    }
    let mut magic = Vec::new();
    let read = File::open(path).and_then(|file| file.take(4).read_to_end(&mut magic));
    read.map_err(|error| bad(&format!("cannot be read ({error})")))?;
    let found = match magic.as_slice() {
        [b'p', b'l', b'y', ..] => Kind::Ply,
        [0x1f, 0x8b, ..] | b"NGSP" => Kind::Spz,
        b"PK\x03\x04" => Kind::Sog,
        b"RAD0" => Kind::Rad,
        [b'{' | b' ' | b'\n' | b'\r' | b'\t' | 0xef, ..] => match serde_json::from_slice(&load(path)?) {
            Ok(Keys { filenames: Some(_), .. }) => Kind::StreamedSog,
            Ok(Keys { means: Some(_), .. }) => Kind::Sog,
            Ok(Keys { root: Some(_), .. }) => Kind::Tiles,
            Ok(_) => return Err(bad("is JSON, but no model's")),
            Err(error) => return Err(bad(&format!("is no JSON of a model ({error})"))),
        },
        _ => return Err(bad("is no model that can be read")),
    };
    Ok((found, path.to_path_buf()))
}

/// The model of the file that [`kind`] found.
pub(crate) fn read(kind: Kind, path: &Path) -> Result<Imported, BadInput> {
    let codec = |error: CodecError| unreadable(path, &error);
    let plain = |(splats, antialiased)| Imported { splats, antialiased, geo_origin: None };
    let imported = match kind {
        Kind::Spz => spz::read(&load(path)?).map(plain).map_err(codec),
        Kind::Sog => sog::read(path).map(plain),
        Kind::StreamedSog => sog::read_streamed(path),
        Kind::Rad => rad::read(&load(path)?).map_err(codec),
        Kind::Tiles => tiles::read(path),
        Kind::Trained | Kind::Ply => {
            let bytes = load(path)?;
            let splats = ply::read(&bytes).map_err(codec)?;
            Ok(plain((splats, ply::comments(&bytes).iter().any(|comment| comment.trim() == ANTIALIASED))))
        }
    }?;
    Ok(Imported { geo_origin: imported.geo_origin.filter(GeoOrigin::is_sane), ..imported })
}

#[cfg(test)]
mod tests;
