//! Figures of several views together, and apart for aerial and street views.

use blocks::ViewKind;
use serde::Serialize;

use crate::figures::{ViewFigures, mean};

/// Means over some views, and the worst of them. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Summary {
    /// Number of views.
    pub views: usize,
    /// dB.
    pub psnr: Option<f64>,
    /// dB, after the affine colour transform of each view.
    pub cc_psnr: Option<f64>,
    /// 0..1.
    pub ssim: Option<f64>,
    /// SSIMULACRA2, up to 100.
    pub ssimulacra2: Option<f64>,
    /// Null without a network.
    pub lpips: Option<f64>,
    /// PSNR of the worst view, dB.
    pub worst_psnr: Option<f64>,
    /// Largest gain of a view's PSNR by its colour transform, dB. A wide gap means wrong colours or exposure, and not blur.
    pub worst_cc_gap: Option<f64>,
}

impl Summary {
    /// The summary of these views.
    pub fn of<'a>(figures: impl Iterator<Item = &'a ViewFigures> + Clone) -> Self {
        let of = |figure: fn(&ViewFigures) -> Option<f64>| mean(figures.clone().map(figure));
        let all = |figure: fn(&ViewFigures) -> Option<f64>| figures.clone().filter_map(figure);
        Self {
            views: figures.clone().count(),
            psnr: of(|view| view.psnr),
            cc_psnr: of(|view| view.cc_psnr),
            ssim: of(|view| Some(view.ssim)),
            ssimulacra2: of(|view| view.perceptual),
            lpips: of(|view| view.lpips),
            worst_psnr: all(|view| view.psnr).min_by(f64::total_cmp),
            worst_cc_gap: all(|view| Some(view.cc_psnr? - view.psnr?)).max_by(f64::total_cmp),
        }
    }
}

/// Summaries apart for aerial and street views; none unless both kinds are there.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ByKind {
    /// Of the aerial views.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub aerial: Option<Summary>,
    /// Of the street views.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub street: Option<Summary>,
}

impl ByKind {
    /// Summaries of the figures of these views; `kinds` are those of all views of the capture.
    pub fn of(figures: &[ViewFigures], views: &[u32], kinds: &[ViewKind]) -> Self {
        let of = |kind: ViewKind| {
            let of_kind = figures.iter().zip(views).filter(move |(_, view)| kinds.get(**view as usize) == Some(&kind));
            Summary::of(of_kind.map(|(figures, _)| figures))
        };
        let [aerial, street] = ViewKind::ALL.map(of);
        if aerial.views == 0 || street.views == 0 {
            return Self::default();
        }
        Self { aerial: Some(aerial), street: Some(street) }
    }
}

/// Figures of views that are reported beside the ordinary held-out ones.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Group {
    /// Of all its views.
    #[serde(flatten)]
    pub all: Summary,
    /// Apart by kind.
    #[serde(flatten)]
    pub by_kind: ByKind,
    /// By view.
    pub figures: Vec<ViewFigures>,
}

impl Group {
    /// The group of these views; `None` without any.
    pub fn of(figures: Vec<ViewFigures>, views: &[u32], kinds: &[ViewKind]) -> Option<Self> {
        let by_kind = ByKind::of(&figures, views, kinds);
        (!figures.is_empty()).then(|| Self { all: Summary::of(figures.iter()), by_kind, figures })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(psnr: Option<f64>, gap: f64) -> ViewFigures {
        let cc_psnr = psnr.map(|psnr| psnr + gap);
        let [psnr_refined, psnr_fitted] = [None; 2];
        ViewFigures {
            view: "a".into(),
            psnr,
            cc_psnr,
            ssim: 0.5,
            perceptual: Some(40.0),
            lpips: None,
            psnr_refined,
            psnr_fitted,
        }
    }

    #[test]
    fn means_and_worst_views_are_apart_by_kind() {
        use ViewKind::{Aerial, Street};
        let figures = [view(Some(20.0), 1.0), view(Some(30.0), 0.5), view(None, 0.0), view(Some(24.0), 3.0)];
        let kinds = [Street, Aerial, Aerial, Aerial, Street, Aerial];
        let group = Group::of(figures.to_vec(), &[0, 1, 3, 4], &kinds).unwrap();
        assert_eq!((group.all.views, group.all.psnr, group.all.worst_psnr), (4, Some(74.0 / 3.0), Some(20.0)));
        let [aerial, street] = [group.by_kind.aerial, group.by_kind.street].map(Option::unwrap);
        assert_eq!((aerial.views, aerial.psnr, aerial.worst_cc_gap), (2, Some(30.0), Some(0.5)));
        assert_eq!((street.views, street.psnr, street.cc_psnr), (2, Some(22.0), Some(24.0)));
        assert_eq!((street.worst_psnr, street.worst_cc_gap, street.ssimulacra2), (Some(20.0), Some(3.0), Some(40.0)));
        // Views of one kind are not reported apart.
        assert_eq!(ByKind::of(&figures, &[1, 2, 3, 5], &kinds), ByKind::default());
        assert_eq!(Group::of(Vec::new(), &[], &kinds), None);
    }
}
