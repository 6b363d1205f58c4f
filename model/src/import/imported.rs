//! What was read, of one file or gathered of several.

use scene::splats::sh_coefficients;
use scene::{CodecError, GeoOrigin, Splats, column};

/// Most memory of gathered splats: this many bytes plus this factor times the files' size. Codecs allow it to each file; without a
/// limit of the sum, many small files could ask for any memory.
const MEMORY_BYTES: u64 = 32 << 20;
const MEMORY_FACTOR: u64 = 32;

/// A model as one set of splats.
#[derive(Debug)]
pub(crate) struct Imported {
    pub(crate) splats: Splats,
    /// Whether they are rendered anti-aliased.
    pub(crate) antialiased: bool,
    /// Where on Earth their origin lies, if the file says it.
    pub(crate) geo_origin: Option<GeoOrigin>,
}

/// Splats with the highest degree of all, and whether all of them are rendered anti-aliased.
pub(super) struct Gathered {
    splats: Splats,
    antialiased: Option<bool>,
    /// What the splats may take, bytes.
    memory: u64,
}

impl Gathered {
    pub(super) fn new() -> Self {
        Self { splats: Splats::new(0), antialiased: None, memory: MEMORY_BYTES }
    }

    /// Says that files of this many bytes were read for what is added next.
    pub(super) fn allow(&mut self, bytes: usize) {
        self.memory = self.memory.saturating_add(MEMORY_FACTOR.saturating_mul(bytes as u64));
    }

    /// Adds splats.
    ///
    /// # Errors
    /// More splats than the files can hold.
    pub(super) fn add(&mut self, part: &Splats, antialiased: bool) -> Result<(), CodecError> {
        let (count, sh_degree) = (self.splats.len() + part.len(), self.splats.sh_degree().max(part.sh_degree()));
        let columns = column::SH + 3 * sh_coefficients(sh_degree);
        if 4 * columns as u64 * count as u64 > self.memory {
            return Err(CodecError::new(format!("has files that are too short for the {count} splats they announce")));
        }
        if sh_degree > self.splats.sh_degree() {
            self.splats = self.splats.with_sh_degree(sh_degree);
        }
        self.splats.append(part);
        self.antialiased = Some(antialiased && self.antialiased.unwrap_or(true));
        Ok(())
    }

    pub(super) fn finish(self, geo_origin: Option<GeoOrigin>) -> Imported {
        Imported { splats: self.splats, antialiased: self.antialiased.unwrap_or(false), geo_origin }
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use scene::Splat;

    use super::*;

    #[test]
    fn many_small_files_are_limited_as_one() {
        let mut part = Splats::new(0);
        (0..100_000).for_each(|_| part.push(&Splat::round(Vec3::ZERO, 0.0, Vec3::ONE, 0.5)));
        let mut all = Gathered::new();
        // 5.6 MB each.
        (0..5).for_each(|_| all.add(&part, true).unwrap());
        assert!(all.add(&part, true).is_err());
        // All become as large as those with the highest degree.
        assert!(all.add(&part.select(&[0]).with_sh_degree(3), true).is_err());
        all.allow(200_000);
        all.add(&part, true).unwrap();
        assert_eq!(all.finish(None).splats.len(), 600_000);
    }
}
