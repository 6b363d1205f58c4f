//! Summaries of further figures by what views are used for and by kind, beside those of [`crate::summary`].

use blocks::{Part, ViewKind};
use serde::Serialize;

/// A summary of some views, and those of each kind if both kinds are among them.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Kinds<S> {
    /// Of all views.
    #[serde(flatten)]
    pub all: S,
    /// Of the aerial views.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub aerial: Option<S>,
    /// Of the street views.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub street: Option<S>,
}

/// Summaries of held-out views, of held-out stretches and of views that were trained on.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Groups<S> {
    /// Of held-out views outside held-out stretches.
    #[serde(flatten)]
    pub held_out: Kinds<S>,
    /// With held-out stretches.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stretches: Option<Kinds<S>>,
    /// Where views that were trained on are measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trained_on: Option<Kinds<S>>,
}

impl<S> Groups<S> {
    /// Summaries of the figures of these views; `kinds` are those of all views of the capture.
    pub(crate) fn of<F>(figures: &[(Part, u32, F)], kinds: &[ViewKind], summary: impl Fn(&[&F]) -> S) -> Self {
        let of = |part: Part, kind: Option<ViewKind>| -> Vec<&F> {
            let is_in = |view: u32| kind.is_none() || kinds.get(view as usize).copied() == kind;
            let of_part = figures.iter().filter(|(of, view, _)| *of == part && is_in(*view));
            of_part.map(|(_, _, figures)| figures).collect()
        };
        let by_kind = |part: Part| {
            let [aerial, street] = ViewKind::ALL.map(|kind| of(part, Some(kind)));
            let both = !aerial.is_empty() && !street.is_empty();
            let [aerial, street] = [aerial, street].map(|views| both.then(|| summary(&views)));
            Kinds { all: summary(&of(part, None)), aerial, street }
        };
        let if_any = |part: Part| figures.iter().any(|(of, ..)| *of == part).then(|| by_kind(part));
        Self { held_out: by_kind(Part::Test), stretches: if_any(Part::Stretch), trained_on: if_any(Part::Trained) }
    }

    /// The summaries that are there, with their names.
    pub fn named(&self) -> Vec<(String, &S)> {
        let groups = [
            ("held out", Some(&self.held_out)),
            ("stretches", self.stretches.as_ref()),
            ("trained on", self.trained_on.as_ref()),
        ];
        let mut all = Vec::new();
        for (name, group) in groups {
            let Some(Kinds { all: of_all, aerial, street }) = group else { continue };
            all.push((name.to_owned(), of_all));
            let kinds = [("aerial", aerial), ("street", street)];
            all.extend(kinds.into_iter().filter_map(|(kind, of)| Some((format!("{name}, {kind}"), of.as_ref()?))));
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_and_kinds_are_apart() {
        use Part::{Stretch, Test, Trained};
        use ViewKind::{Aerial, Street};
        let kinds = [Street, Aerial, Street, Street];
        let sum = |values: &[&u32]| values.iter().copied().sum::<u32>();
        let figures = [(Test, 0, 1), (Test, 1, 10), (Stretch, 2, 100), (Trained, 3, 1000), (Trained, 0, 3000)];
        let groups = Groups::of(&figures, &kinds, sum);
        assert_eq!(groups.held_out, Kinds { all: 11, aerial: Some(10), street: Some(1) });
        assert_eq!(groups.stretches, Some(Kinds { all: 100, aerial: None, street: None }));
        assert_eq!(groups.trained_on, Some(Kinds { all: 4000, aerial: None, street: None }));
        let names: Vec<String> = groups.named().into_iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["held out", "held out, aerial", "held out, street", "stretches", "trained on"]);
        assert_eq!(Groups::of(&figures[..2], &kinds, sum).trained_on, None);
    }
}
