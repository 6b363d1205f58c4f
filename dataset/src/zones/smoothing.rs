//! Smooths boxes over three photos of a sequence (SDG, section 3.2: a moving average over three frames against jitter).

use perceive::iou;
use scene::{Zone, Zones};

/// Least overlap of the zones of one object on photos that follow each other.
const SAME: f32 = 0.5;

/// The zones, each averaged with those of the same object on the photos before and after. An object that both of them show,
/// and the photo between does not, is added there. Zones with masks are exact and stay as they are. `follows` says whether
/// a view follows the one before it in a sequence.
pub(super) fn smoothed(of_views: &[Vec<Zone>], follows: impl Fn(usize) -> bool) -> Vec<Vec<Zone>> {
    let middle = |view: usize| view > 0 && view + 1 < of_views.len() && follows(view) && follows(view + 1);
    let smooth = |view: usize| {
        let mut zones = of_views[view].clone();
        if middle(view) {
            let (before, after) = (&of_views[view - 1], &of_views[view + 1]);
            for zone in zones.iter_mut().filter(|zone| zone.mask.is_none()) {
                // With one neighbour only, the mean of a moving object would lag behind.
                if let (Some(a), Some(b)) = (same(zone, before), same(zone, after)) {
                    zone.corners = mean(&[a.corners, zone.corners, b.corners]);
                }
            }
            for a in before {
                let Some(b) = same(a, after).filter(|b| a.mask.is_none() && b.mask.is_none()) else { continue };
                let between = Zone { corners: mean(&[a.corners, b.corners]), score: a.score.min(b.score), ..a.clone() };
                if same(&between, &zones).is_none() && zones.len() < Zones::MAX {
                    zones.push(between);
                }
            }
        }
        zones
    };
    (0..of_views.len()).map(smooth).collect()
}

/// The zone of the same class that overlaps `zone` most, at least by [`SAME`].
fn same<'a>(zone: &Zone, among: &'a [Zone]) -> Option<&'a Zone> {
    let overlaps = among.iter().filter(|of| of.class == zone.class).map(|of| (iou(of.corners, zone.corners), of));
    let best = overlaps.filter(|(overlap, _)| *overlap >= SAME).reduce(|a, b| if b.0 > a.0 { b } else { a });
    best.map(|(_, of)| of)
}

fn mean(of: &[[f32; 4]]) -> [f32; 4] {
    std::array::from_fn(|k| of.iter().map(|corners| corners[k]).sum::<f32>() / of.len() as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn car(left: f32) -> Zone {
        Zone { corners: [left, 10.0, left + 20.0, 20.0], class: 0, score: 0.5, mask: None }
    }

    #[test]
    fn jitter_is_averaged_and_a_gap_is_filled() {
        let frames = [vec![car(0.0)], vec![car(5.0)], vec![car(4.0)], vec![], vec![car(6.0)], vec![car(90.0)]];
        let smooth = smoothed(&frames, |view| view > 0);
        assert_eq!(smooth[1], [car(3.0)]);
        // The next photo lacks it.
        assert_eq!(smooth[2], [car(4.0)]);
        assert_eq!(smooth[3], [car(5.0)]);
        assert_eq!([&smooth[0], &smooth[4], &smooth[5]], [&frames[0], &frames[4], &frames[5]]);
        // Another sequence begins with the second photo, another class is another object.
        assert_eq!(smoothed(&frames, |view| view > 1)[1], [car(5.0)]);
        let bus = |of: &Zone| Zone { class: 1, ..of.clone() };
        let frames = [vec![car(0.0)], vec![bus(&car(0.0))], vec![car(0.0)]];
        assert_eq!(smoothed(&frames, |view| view > 0)[1], [bus(&car(0.0)), car(0.0)]);
        let masked = |left| Zone { mask: row(), ..car(left) };
        let frames = [vec![masked(0.0)], vec![masked(5.0)], vec![masked(4.0)], vec![], vec![masked(4.0)]];
        assert_eq!(smoothed(&frames, |view| view > 0), frames);
    }

    fn row() -> Option<scene::ZoneMask> {
        let mut builder = scene::MaskBuilder::new(40);
        builder.push(10, 0..20);
        builder.finish().map(|(mask, _)| mask)
    }
}
