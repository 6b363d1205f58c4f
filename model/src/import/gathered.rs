//! The splats of several files as one set.

use scene::Splats;

/// Splats with the highest degree of all, and whether all of them are rendered anti-aliased.
pub(super) struct Gathered {
    splats: Splats,
    antialiased: Option<bool>,
}

impl Gathered {
    pub(super) fn new() -> Self {
        Self { splats: Splats::new(0), antialiased: None }
    }

    pub(super) fn add(&mut self, part: &Splats, antialiased: bool) {
        if part.sh_degree() > self.splats.sh_degree() {
            self.splats = self.splats.with_sh_degree(part.sh_degree());
        }
        self.splats.append(part);
        self.antialiased = Some(antialiased && self.antialiased.unwrap_or(true));
    }

    pub(super) fn finish(self) -> (Splats, bool) {
        (self.splats, self.antialiased.unwrap_or(false))
    }
}
