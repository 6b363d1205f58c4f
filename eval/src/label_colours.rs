//! Colours splats by an attribute, to look at where labels lie.

use glam::Vec3;
use scene::{SH_C0, Splats, column};

/// Share of a splat's own brightness in its label's colour: enough to recognise the scene.
const SHADING: f32 = 0.6;
/// Colour of splats whose attribute is unset.
const UNSET: Vec3 = Vec3::splat(0.5);

/// The same splats, at SH degree 0, with one colour per value of an attribute; `None` without that attribute. Equal values have
/// equal hues. Hues of consecutive values are far apart (golden ratio). The value 0, unset, is grey.
pub fn coloured_by(splats: &Splats, attribute: &str) -> Option<Splats> {
    let values = splats.attribute(attribute)?;
    let mut coloured = splats.with_sh_degree(0);
    for (i, &value) in values.iter().enumerate() {
        let own = Vec3::from_array([0, 1, 2].map(|channel| SH_C0 * splats.col(column::SH + channel)[i] + 0.5));
        let brightness = own.dot(Vec3::new(0.299, 0.587, 0.114)).clamp(0.0, 1.0);
        let colour = label_colour(value) * (1.0 - SHADING + SHADING * brightness);
        for (channel, value) in colour.to_array().into_iter().enumerate() {
            coloured.columns_mut()[column::SH + channel][i] = (value - 0.5) / SH_C0;
        }
    }
    Some(coloured)
}

/// The same splats in one sRGB colour, at SH degree 0.
pub fn painted(splats: &Splats, colour: Vec3) -> Splats {
    let mut painted = splats.with_sh_degree(0);
    for (channel, value) in colour.to_array().into_iter().enumerate() {
        painted.columns_mut()[column::SH + channel].fill((value - 0.5) / SH_C0);
    }
    painted
}

/// sRGB in 0..1, saturated and bright: its largest channel is 1.
pub fn label_colour(value: u32) -> Vec3 {
    const GOLDEN_RATIO: f64 = 0.618_033_988_749_894_9;
    if value == 0 {
        return UNSET;
    }
    let hue = (6.0 * (f64::from(value) * GOLDEN_RATIO).fract()) as f32;
    let channel = |shift: f32| 0.25 + 0.75 * ((hue + shift).rem_euclid(6.0) - 3.0).abs().clamp(1.0, 2.0) - 0.75;
    Vec3::new(channel(0.0), channel(4.0), channel(2.0))
}

#[cfg(test)]
mod tests {
    use scene::Splat;

    use super::*;

    #[test]
    fn equal_labels_have_equal_hues_and_others_differ() {
        let mut splats = Splats::new(1);
        (0..4).for_each(|i| splats.push(&Splat::round(Vec3::splat(i as f32), -1.0, Vec3::splat(0.8), 0.5)));
        assert_eq!(coloured_by(&splats, "block"), None);
        splats.set_attribute("block", vec![0, 1, 2, 1]);
        let coloured = coloured_by(&splats, "block").unwrap();
        let colour = |i: usize| coloured.get(i).sh[0];
        assert_eq!((coloured.sh_degree(), coloured.len()), (0, 4));
        assert_eq!(colour(1), colour(3));
        let is_grey = |[r, g, b]: [f32; 3]| (r - g).abs() < 1e-6 && (g - b).abs() < 1e-6;
        assert_eq!([0, 1, 2].map(|i| is_grey(colour(i))), [true, false, false]);
        assert!(colour(1) != colour(2));
        for value in 0..100 {
            assert!(label_colour(value).to_array().iter().all(|channel| (0.0..=1.0).contains(channel)));
        }
    }
}
